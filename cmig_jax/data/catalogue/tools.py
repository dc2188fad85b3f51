"""Tools: hammer, wrench, saw, drill; axe, pliers, plane, shovel. Lengths in decimetres; the handle lies along x."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from cmig_jax.data.solids import Solid, ball, box, curve, cylinder, hull, lathe, loft, panel, plate, ring, rod, tube


def hammer(rng: Generator) -> list[Solid]:
    """Make a hammer: a round or square face on one side, a claw, a wedge or a ball on the other."""
    u = rng.uniform
    long, r, head = u(1.3, 2.4), u(0.1, 0.16), u(0.25, 0.42)
    parts = [_grip(rng, -long, 0, r), box(head, head * 0.9, head * 1.2).at(z=-head * 0.6)]
    face = cylinder(head * u(0.4, 0.65), u(0.2, 0.6)) if rng.random() < 0.6 else box(head, head, u(0.2, 0.6), u(0.8, 1.1))
    parts += [face.at(z=head * 0.45), cylinder(head * 0.35, 0.2).at(z=head * 0.3)]
    kind = rng.integers(3)
    back = -head * 0.5
    if kind == 0:
        for s in (-1, 1):
            claw = curve([(0, s * 0.05, back), (0, s * 0.12, back - 0.4), (-u(0.2, 0.5), s * 0.2, back - u(0.5, 0.8))], 8)
            parts.append(tube(claw, np.linspace(0.12, 0.04, 8)))
    elif kind == 1:
        edge = u(0.5, 0.9)
        rings = [[(-0.12, -0.12), (0.12, -0.12), (0.12, 0.12), (-0.12, 0.12)], [(-0.02, -0.2), (0.02, -0.2), (0.02, 0.2), (-0.02, 0.2)]]
        if rng.random() < 0.5:
            rings[1] = [(y, x) for x, y in rings[1]]
            rings[1] = [rings[1][i] for i in (0, 3, 2, 1)]
        parts.append(loft(np.array([[(x, y, back - edge * i) for x, y in outline] for i, outline in enumerate(rings)])))
    else:
        parts += [ball(head * 0.5).at(z=back - head * 0.4), cylinder(head * 0.35, 0.2).at(z=back - 0.1)]
    return parts


def wrench(rng: Generator) -> list[Solid]:
    """Make a wrench: an angled open jaw at one end, a cranked ring, a smaller jaw, or an adjusting worm at the other."""
    u = rng.uniform
    long, t, width = u(1.4, 2.5), u(0.1, 0.2), u(0.22, 0.38)
    parts = [
        box(long, width * u(0.7, 1), t).at(z=-t / 2),
        hull([(-long / 2, width, -t, t), (0, width * 0.5, -t * 0.4, t * 0.4), (long / 2, width, -t, t)], 0.4, 10),
    ]
    jaw, angle = u(0.35, 0.65), u(10, 50)
    parts += [part.turned("z", angle).at(x=long / 2) for part in _jaw(jaw, t * 1.4, u(0.5, 1.0))]
    kind = rng.integers(3)
    lift = u(0.1, 0.4)
    if kind == 0:
        r = u(0.2, 0.4)
        parts += [
            ring(r, t * 0.8, sections=10).at(-long / 2 - r * 0.9, 0, lift),
            rod((-long / 2 + 0.2, 0, 0), (-long / 2 - 0.1, 0, lift), t * 0.8),
        ]
    elif kind == 1:
        parts += [part.turned("z", 180 - angle * u(0.3, 1)).at(-long / 2, 0, lift * 0.5) for part in _jaw(jaw * u(0.5, 0.75), t * 1.2, 0.7)]
    else:
        parts += [
            rod((long / 2 - 0.05, -0.2, 0), (long / 2 - 0.05, 0.25, 0), 0.13, sections=10),
            box(0.4, 0.15, t * 2.5).at(long / 2 - 0.1, width * 0.7, -t),
        ]
        parts.append(ring(width * 0.4, t * 0.5).at(-long / 2 - width * 0.2, 0, lift * 0.5))
    return parts


def saw(rng: Generator) -> list[Solid]:
    """Make a saw: a panel saw with teeth and a looped handle, a back saw with its rib, or a bow saw with its frame."""
    u = rng.uniform
    long, high, low, t = u(2.2, 4.0), u(0.6, 1.1), u(0.2, 0.6), 0.05
    kind = rng.integers(3)
    if kind == 2:
        arch = u(0.7, 1.3)
        frame = curve([(0, 0, 0), (0, 0, arch * 1.4), (long, 0, arch * u(0.8, 1.4)), (long, 0, 0)], 14)
        parts, high = [tube(frame, u(0.06, 0.1)), box(long, t, 0.2).at(x=long / 2, z=-0.1)], arch
    else:
        low = high * u(0.85, 1) if kind == 1 else low
        parts = [panel([(0, 0), (long, 0), (long, low), (0, high)], t)]
        parts += [rod((0, 0, high), (long, 0, low), u(0.06, 0.1), sections=6)] if kind == 1 else []
    teeth = int(rng.integers(8, 16))
    tooth = panel([(0, 0.02), (long / teeth, 0.02), (long / teeth * u(0.2, 0.8), -u(0.08, 0.2))], t)
    start = 0.1 if kind == 2 else 0.0
    parts += [tooth.at(x=long * i / teeth, z=-start) for i in range(teeth)]
    r, tall = u(0.09, 0.14), u(0.7, 1.0)
    loop = curve([(0.05, 0, 0.1), (-0.9, 0, -0.4), (-1.1, 0, tall * 1.1), (0.05, 0, max(high, tall) * 0.85)], 12)
    parts.append(tube(loop, r))
    if rng.random() < 0.5:
        parts.append(rod((0.05, 0, 0.1), (0.05, 0, high * 0.85), r))
    return parts


def drill(rng: Generator) -> list[Solid]:
    """Make a power drill: motor, chuck and bit, pistol grip with trigger and battery or cord, sometimes a side handle."""
    u = rng.uniform
    long, r, grip, lean = u(1.0, 1.6), u(0.28, 0.42), u(0.8, 1.3), u(-5, 25)
    spine = [
        (-long / 2, r, -r * 0.5, r * 0.5),
        (-long * 0.4, r * 1.9, -r, r),
        (long * 0.3, r * 2, -r, r * u(0.9, 1.1)),
        (long / 2, r * 1.2, -r * 0.6, r * 0.6),
    ]
    parts = [hull(spine, u(0, 0.5)), lathe([(r * 0.6, 0), (r * 0.6, 0.3), (r * 0.25, 0.5)], 12).turned("y", 90).at(x=long / 2)]
    parts.append(rod((long / 2, 0, 0), (long / 2 + u(0.7, 1.5), 0, 0), u(0.03, 0.07), 0.8, 6))
    hold = [box(u(0.35, 0.5), r * 1.3, grip + 0.1, 0.9).at(z=-grip)]
    if rng.random() < 0.6:
        hold.append(box(u(0.7, 1.1), r * 2, u(0.25, 0.45)).at(u(-0.1, 0.2), 0, -grip - 0.25))
    else:
        cord = curve([(0, 0, -grip), (-0.1, 0, -grip - 0.8), (-0.6, u(-0.6, 0.6), -grip - 0.6), (-1.2, u(-0.6, 0.6), -grip - 1)], 12)
        hold.append(tube(cord, 0.06, 6))
    hold.append(box(0.15, r * 0.7, 0.3).at(0.27, 0, -r - 0.3))
    parts += [part.turned("y", lean).at(x=-long * u(0.1, 0.3) if i < 0 else -long * 0.2) for i, part in enumerate(hold)]
    if rng.random() < 0.4:
        s = rng.choice((-1, 1))
        parts += [rod((long * 0.4, 0, 0), (long * 0.4, s * u(0.9, 1.3), 0), 0.1), cylinder(r * 1.1, 0.15).turned("y", 90).at(x=long * 0.35)]
    return parts


def axe(rng: Generator) -> list[Solid]:
    """Make an axe: a curved handle with a swell at its end, a bearded or plain blade, a poll, a spike or a second, smaller blade."""
    u = rng.uniform
    long, r = u(2.4, 4.5), u(0.09, 0.15)
    bow = u(-0.3, 0.3)
    path = curve([(-long, 0, bow * 0.5 - 0.1), (-long * 0.6, 0, bow), (-long * 0.3, 0, -bow), (0.25, 0, 0)], 12)
    parts = [tube(path, [r * 1.5, *np.linspace(r * 1.1, r, 11)], 8), box(0.5, 0.3, 0.4).at(z=-0.2)]
    parts.append(_blade(u(0.6, 1.2), u(0.3, 1.0), u(0.1, 0.7), 0.13).at(z=0.15))
    kind = rng.integers(3)
    if kind == 0:
        poll = u(0.1, 0.4)
        parts.append(box(0.4, 0.25, poll).at(z=-0.15 - poll))
    elif kind == 1:
        parts.append(tube(curve([(0, 0, -0.1), (0, 0, -0.6), (-u(0.1, 0.5), 0, -u(0.7, 1.1))], 6), np.linspace(0.14, 0.02, 6)))
    else:
        parts.append(_blade(u(0.3, 0.6), u(0.2, 0.4), u(0.1, 0.3), 0.1).turned("x", 180).at(z=-0.15))
    if rng.random() < 0.4:
        parts.append(cylinder(r * 1.3, u(0.4, 0.9)).turned("y", 90).at(x=-long * u(0.85, 0.95), z=bow * 0.3))
    return parts


def pliers(rng: Generator) -> list[Solid]:
    """Make pliers: two bent handles open at some angle, long, flat or bent jaws, a pivot with a nut on one side."""
    u = rng.uniform
    long, jaw, opening, r = u(1.3, 2.2), u(0.5, 1.3), u(4, 20), u(0.07, 0.12)
    nose, droop = u(0.2, 0.6), u(-0.4, 0.4) * (rng.random() < 0.6)
    parts = [cylinder(u(0.14, 0.22), 0.3).at(z=-0.15), cylinder(0.1, u(0.2, 0.35)).at(z=0.05)]
    for s in (-1, 1):
        grip = curve(
            [
                (0.1, s * 0.05, 0),
                (-long * 0.3, -s * 0.15, 0),
                (-long * 0.5, -s * u(0.5, 0.8), 0),
                (-long * u(0.9, 1.1), -s * u(0.3, 0.5), 0),
            ],
            12,
        )
        side = [tube(grip, np.linspace(r, r * u(1, 1.7), 12)), ball(0.25, 0.16, 0.13)]
        tip = np.array([(0, s * 0.02, -0.12), (0, s * 0.24, -0.12), (0, s * 0.24, 0.12), (0, s * 0.02, 0.12)])
        side.append(loft(np.stack([tip, tip * (1, 0.9, 0.8) + (jaw * 0.5, 0, droop * 0.3), tip * (1, nose, nose) + (jaw, 0, droop)])))
        parts += [part.turned("z", s * opening) for part in side]
    if rng.random() < 0.4:
        parts.append(tube(curve([(-long * 0.4, -0.3, 0), (-long * 0.6, 0, 0.2), (-long * 0.4, 0.3, 0)], 8), 0.04, 6))
    return parts


def plane(rng: Generator) -> list[Solid]:
    """Make a wood plane: a sole, a knob in front, a tote behind, an iron at a slope, an adjusting wheel."""
    u = rng.uniform
    long, width, t = u(1.4, 3.2), u(0.45, 0.8), u(0.1, 0.3)
    parts = [box(long, width, t)]
    if rng.random() < 0.5:
        parts += [box(long * u(0.4, 0.7), 0.06, u(0.2, 0.45), 0.7).at(x=u(-0.1, 0.1), y=s * (width / 2 - 0.03), z=t * 0.8) for s in (-1, 1)]
    front, back = long * u(0.3, 0.4), -long * u(0.25, 0.38)
    parts.append(lathe([(0.15, 0), (0.1, 0.15), (0.2, 0.35), (0.12, 0.5), (0, 0.52)], 12).at(front, 0, t * 0.9))
    if rng.random() < 0.6:
        tote = curve([(back + 0.2, 0, t), (back - 0.2, 0, t + 0.3), (back + 0.3, 0, t + 0.5), (back - 0.05, 0, t + u(0.8, 1.1))], 10)
        parts.append(tube(tote, [0.16, 0.15, 0.13, 0.12, 0.12, 0.12, 0.12, 0.12, 0.13, 0.15]))
    else:
        parts.append(
            hull([(-0.4, width * 0.5, 0, 0.2), (0, width * 0.8, 0, u(0.3, 0.6)), (0.3, width * 0.6, 0, 0.3)], 0.2).at(back, 0, t * 0.9)
        )
    slope, x = u(35, 60), u(-0.05, 0.1) * long
    parts += [
        part.turned("y", -slope).at(x, 0, t * 0.5)
        for part in (box(0.08, width * 0.6, u(0.9, 1.3)), box(0.14, width * 0.5, 0.6).at(0.08, 0, 0.1))
    ]
    parts.append(cylinder(0.14, 0.1).turned("y", -70).at(x - 0.35, 0, t + 0.3))
    if rng.random() < 0.5:
        s = rng.choice((-1, 1))
        parts += [
            box(long * 0.8, 0.08, u(0.3, 0.5)).at(0, s * (width / 2 + 0.2), -0.15),
            *(rod((f * long, 0, 0.1), (f * long, s * (width / 2 + 0.25), 0.1), 0.05) for f in (-0.2, 0.2)),
        ]
    return parts


def shovel(rng: Generator) -> list[Solid]:
    """Make a shovel, a hoe or a rake: a shaft with a D grip, a T grip or none, and a dished, square or toothed head."""
    u = rng.uniform
    long, r, wide = u(1.6, 3.4), u(0.06, 0.1), u(0.7, 1.3)
    parts = [rod((-long, 0, 0), (0, 0, 0), r)]
    top = rng.integers(3)
    if top == 0:
        parts.append(
            tube(
                [(-long, 0, 0), (-long - 0.25, -0.25, 0), (-long - 0.5, -0.25, 0), (-long - 0.5, 0.25, 0), (-long - 0.25, 0.25, 0)],
                r * 0.9,
                6,
                closed=True,
            )
        )
    elif top == 1:
        parts.append(rod((-long, -0.35, 0), (-long, 0.35, 0), r * 1.1))
    kind = rng.integers(3)
    if kind < 2:
        deep, dish, tip = u(0.8, 1.5), u(0.05, 0.25), (0.15 if kind == 0 else 1.0)
        sizes = [(0, 0.5), (0.12, 1), (0.65, 1), (1, tip)]
        y = np.array([-1, -0.5, 0, 0.5, 1, 1, 0.5, 0, -0.5, -1])
        z = np.array([1, 0.25, 0, 0.25, 1, 1, 0.25, 0, 0.25, 1]) * dish + np.repeat([0, 0.05], 5)
        blade = loft(np.stack([np.stack([0 * y + x * deep, y * wide / 2 * f, z * f], -1) for x, f in sizes]))
        parts += [blade.turned("y", u(-5, 25)), rod((-0.4, 0, 0), (0.3, 0, 0.03), r * 1.5)]
    else:
        parts += [
            box(0.1, wide * 1.6, 0.1).at(z=-0.05),
            rod((0, 0, 0), (-0.6, wide * 0.5, 0), r * 0.6),
            rod((0, 0, 0), (-0.6, -wide * 0.5, 0), r * 0.6),
        ]
        teeth, drop = int(rng.integers(4, 10)), u(0.3, 0.7)
        parts += [rod((0, y, 0), (u(0.05, 0.2), y, -drop), 0.05, 0.4, 6) for y in (np.arange(teeth) / (teeth - 1) - 0.5) * wide * 1.5]
    return parts


def _grip(rng: Generator, start: float, end: float, radius: float) -> Solid:
    swell = rng.uniform(1, 1.5)
    x = np.linspace(start, end, 6)
    return tube(np.stack([x, 0 * x, 0 * x], -1), radius * np.array([swell, swell, 1, 0.8, 0.8, 0.9]), 10)


def _jaw(size: float, thick: float, gap: float) -> list[Solid]:
    """Two prongs on a neck, opening towards +x."""
    prong = [(0, 0.3 * gap), (0.9, 0.4 * gap), (1.0, 0.4 * gap + 0.3), (0.4, 0.9), (-0.3, 0.8)]
    parts = [plate([(x * size, s * y * size) for x, y in prong], thick).at(z=-thick / 2) for s in (-1, 1)]
    return [*parts, box(size * 0.7, size * 1.3, thick).at(x=-size * 0.1, z=-thick / 2)]


def _blade(reach: float, flare: float, beard: float, thick: float) -> Solid:
    """A wedge from the eye at z = 0 to an edge at z = `reach`, `flare` longer than the eye and pulled back by `beard`."""
    eye, edge = np.array([(-0.25, -thick), (0.25, -thick), (0.25, thick), (-0.25, thick)]), 0.015
    wide = np.array(
        [(-0.25 - flare * beard - 0.1, -edge), (0.25 + flare * 0.4, -edge), (0.25 + flare * 0.4, edge), (-0.25 - flare * beard - 0.1, edge)]
    )
    levels = [(eye, 0.0), ((eye * (1, 0.6) + wide * 0.1), reach * 0.5), (wide, reach)]
    return loft(np.array([[(x, y, z) for x, y in outline] for outline, z in levels]))
