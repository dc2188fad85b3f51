"""Vehicles of air and water: airplane, boat; helicopter. Lengths in metres; x is the direction of travel."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from cmig_jax.data.solids import Solid, ball, box, cylinder, hull, lathe, loft, panel, rod


def airplane(rng: Generator) -> list[Solid]:
    """Make an airplane: wings high or low, swept or straight, tail of two kinds, engines under the wings, behind or in the nose."""
    u = rng.uniform
    long, r = u(7, 11), u(0.45, 0.9)
    nose, tail = long * 0.5, -long * 0.5
    spine = [
        (tail, 0.15, r * 0.5, r * 0.8),
        (tail * 0.5, r * 1.6, -r * 0.6, r * 0.95),
        (nose * 0.6, r * 2, -r, r),
        (nose * 0.9, r * 1.3, -r * 0.7, r * 0.5),
    ]
    parts = [hull([*spine, (nose, 0.15, -r * 0.25, 0.0)], 0.0)]
    span, chord, sweep, height = u(3, 6), u(1, 2), u(-0.2, 3), rng.choice((-0.6, 0.0, 0.8)) * r
    x, rise = u(-0.1, 0.12) * long, u(-0.05, 0.15)
    parts += _wings(span, chord, sweep, u(0.3, 0.8), rise, (x, height))
    fin = u(0.8, 1.8)
    parts.append(_fin(fin, u(0.8, 1.3), u(0.3, 1.2)).at(tail * 0.9, 0, r * 0.6))
    parts += _wings(
        span * u(0.3, 0.45), chord * 0.6, sweep * 0.4, 0.6, 0.05, (tail * 0.92, r * 0.6 + (fin * 0.9 if rng.random() < 0.3 else 0))
    )
    engines = rng.integers(4)
    if engines == 0:
        parts += [
            rod((nose, -1.0, -0.1), (nose, 1.0, 0.0), 0.06, sections=4).turned("x", u(0, 90)),
            ball(0.25, 0.15, 0.15).at(nose, 0, -0.1),
        ]
    elif engines == 3:
        parts += [rod((tail * 0.75, s * r * 1.5, r * 0.5), (tail * 0.45, s * r * 1.5, r * 0.5), 0.3, 1.1, 10) for s in (-1, 1)]
    else:
        for y in np.arange(1, engines + 1) * span * 0.33:
            parts += [
                lathe([(0.22, 0), (0.34, 0.7), (0.3, 1.2)], 12)
                .turned("y", 90)
                .at(x - sweep * y / span * 0.5, s * y, height + rise * y - 0.35)
                for s in (-1, 1)
            ]
    if rng.random() < 0.5:
        parts += [rod((a, b, -r * 0.5), (a, b, -r - 0.8), 0.07) for a, b in ((nose * 0.7, 0), (x, 0.9), (x, -0.9))]
    return parts


def boat(rng: Generator) -> list[Solid]:
    """Make a boat: an open or decked hull with a mast and sail, a cabin with a funnel, or an outboard motor and thwarts."""
    u = rng.uniform
    long, beam, deep, sheer = u(3, 7), u(1.2, 2.2), u(0.5, 1.1), u(0.1, 0.5)
    stern = u(0.5, 0.95)
    spine = [(-long / 2, beam * stern, 0.1, deep), (-long * 0.2, beam, 0, deep), (long * 0.2, beam * 0.9, 0, deep + sheer * 0.3)]
    parts = [hull([*spine, (long * 0.4, beam * 0.5, 0.1, deep + sheer * 0.7), (long * 0.5, 0.08, deep * 0.5, deep + sheer)], 0.3)]
    kind = rng.integers(3)
    if kind == 0:
        mast, x = long * u(0.8, 1.3), long * u(0, 0.15)
        parts += [rod((x, 0, 0.2), (x, 0, deep + mast), 0.06), rod((x, 0, deep + 0.4), (x - long * 0.45, 0, deep + 0.4), 0.05)]
        parts.append(panel([(x - 0.05, deep + 0.45), (x - long * 0.45, deep + 0.45), (x - 0.05, deep + mast * 0.95)], 0.06))
        parts.append(box(0.5, 0.06, 0.9).at(-long * 0.1, 0, -0.8))
    elif kind == 1:
        size, x, tall = long * u(0.2, 0.45), -long * u(-0.05, 0.15), u(0.5, 1.1)
        parts += [
            box(size, beam * 0.7, tall, u(0.8, 1)).at(x, 0, deep),
            box(size * 0.4, beam * 0.6, 0.5).at(x + size * 0.2, 0, deep + tall),
        ]
        parts += [cylinder(0.18, 0.9, u(0.8, 1.2)).turned("y", -u(0, 15)).at(x - size * 0.3, 0, deep + tall * 0.8)] * int(rng.integers(2))
        parts += [rod((long * 0.3, 0, deep), (long * 0.3, 0, deep + u(0.8, 2)), 0.05)]
    else:
        parts += [box(0.3, beam * 0.95, 0.08).at(x * long, 0, deep + 0.05) for x in (-0.25, 0.05)]
        parts += [box(0.35, 0.3, 0.5, 0.8).at(-long * 0.53, 0, deep), rod((-long * 0.53, 0, deep), (-long * 0.53, 0, -0.3), 0.08)]
        parts += [rod((0, 0, deep + 0.2), (u(-1, 1), s * beam * u(0.8, 1.3), deep - 0.2), 0.05, 1.6) for s in (-1, 1)][
            : int(rng.integers(3))
        ]
    return parts


def helicopter(rng: Generator) -> list[Solid]:
    """Make a helicopter: cabin, tail boom with a side rotor, two to five blades, skids or wheels."""
    u = rng.uniform
    long, width, h, boom = u(2, 3.6), u(1.1, 1.7), u(1.2, 1.7), u(2.2, 4)
    spine = [
        (-long / 2, width * 0.4, h * 0.5, h),
        (-long * 0.25, width, 0.1, h),
        (long * 0.15, width, 0, h),
        (long * 0.4, width * 0.8, 0.05, h * 0.65),
    ]
    parts = [
        hull([*spine, (long * 0.5, width * 0.3, h * 0.15, h * 0.35)], u(0, 0.5)),
        rod((-long * 0.4, 0, h * 0.75), (-long / 2 - boom, 0, h * u(0.8, 1.1)), 0.25, 0.35),
    ]
    tail, side = -long / 2 - boom, rng.choice((-1, 1))
    parts += [_fin(u(0.5, 1.0), 0.6, 0.4).at(tail, 0, h * 0.8), box(0.3, u(0.8, 1.4), 0.05).at(tail + 0.6, 0, h * 0.85)]
    parts += [box(0.1, 0.03, u(0.9, 1.2)).at(z=-0.5).turned("y", 90 * i + 20).at(tail, side * 0.18, h * 0.95) for i in range(2)]
    mast, blades, reach, start = h + u(0.25, 0.5), int(rng.integers(2, 6)), u(2.3, 3.6), u(0, 90)
    parts += [rod((0, 0, h * 0.9), (0, 0, mast), 0.08), box(long * 0.4, width * 0.4, 0.3, 0.7).at(-0.2, 0, h * 0.95)]
    parts += [box(reach, 0.2, 0.04).at(x=reach / 2).turned("z", start + 360 * i / blades).at(z=mast) for i in range(blades)]
    for s in (-1, 1):
        if rng.random() < 0.75:
            parts.append(rod((-long * 0.4, s * width * 0.5, -0.4), (long * 0.4, s * width * 0.5, -0.4), 0.06))
        parts += [rod((x * long, s * width * 0.3, 0.2), (x * long, s * width * 0.5, -0.4), 0.05) for x in (-0.2, 0.2)]
    return parts


def _wings(span: float, chord: float, sweep: float, taper: float, rise: float, at: tuple[float, float]) -> list[Solid]:
    root = np.array([[-chord / 2, 0, 0], [0, 0, 0.12], [chord / 2, 0, 0], [0, 0, -0.06]])
    tip = root * (taper, 1, taper) + (-sweep, span, rise * span)
    return [loft(np.stack([root, tip]) * (1, s, 1) + (at[0], 0, at[1])) for s in (-1, 1)]


def _fin(height: float, chord: float, sweep: float) -> Solid:
    root = np.array([[-chord / 2, 0, 0], [0, 0.06, 0], [chord / 2, 0, 0], [0, -0.06, 0]])
    return loft(np.stack([root, root * (0.5, 0.5, 1) + (-sweep, 0, height)]))
