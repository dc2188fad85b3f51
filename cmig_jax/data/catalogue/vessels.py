"""Vessels: mug, teapot, bucket, saucepan; jug, watering can, bathtub, spray bottle. Lengths in decimetres."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from cmig_jax.data.solids import Solid, ball, box, curve, cylinder, hull, lathe, loft, ring, rod, tube, vessel


def mug(rng: Generator) -> list[Solid]:
    """Make a mug: a straight or bellied cup with a handle, sometimes with a spoon in it or a saucer off centre."""
    u = rng.uniform
    radius, height = u(0.35, 0.55), u(0.6, 1.3)
    belly, rim = u(0.85, 1.25), u(0.8, 1.2)
    outer = [(radius * u(0.6, 1), 0), (radius * belly, height * 0.35), (radius * (belly + rim) / 2, height * 0.7), (radius * rim, height)]
    parts = [vessel(outer, u(0.04, 0.08)), *_handle(rng, radius * min(belly, rim) * 0.95, height * 0.15, height * 0.85, u(0.3, 0.6))]
    if rng.random() < 0.4:
        lean = (u(-0.3, 0.3) * radius, u(0.5, 0.8) * radius)
        parts += [rod((0, 0, 0.1), (*lean, height * 1.4), 0.03), ball(0.12, 0.03, 0.16).at(lean[0] * 1.05, lean[1] * 1.05, height * 1.5)]
    if rng.random() < 0.3:
        parts.append(vessel([(radius * 0.8, -0.1), (radius * 1.9, 0.06)], 0.06).at(x=u(-0.2, 0.1)))
    return parts


def teapot(rng: Generator) -> list[Solid]:
    """Make a teapot: belly, spout in front, handle behind or above, lid with a knob."""
    u = rng.uniform
    r, h = u(0.7, 1.0), u(0.8, 1.6)
    parts = [lathe([(r * 0.6, 0), (r * u(0.85, 1.05), h * 0.3), (r * u(0.8, 1), h * 0.6), (r * 0.5, h), (0, h * 1.05)])]
    parts += [ball(0.12).at(z=h * 1.12), cylinder(r * 0.55, 0.08, 0.8).at(z=h * 0.97)]
    out = u(0.5, 0.9)
    path = curve([(r * 0.7, 0, h * 0.3), (r + out * 0.6, 0, h * 0.3), (r + out * 0.4, 0, h * 0.9), (r + out, 0, h * u(0.9, 1.15))])
    parts.append(tube(path, np.linspace(u(0.15, 0.25), 0.08, 10), 10))
    if rng.random() < 0.6:
        parts += [part.turned("z", 180) for part in _handle(rng, r * 0.8, h * 0.25, h * 0.85, u(0.5, 0.8))]
    else:
        parts.append(tube(curve([(-r * 0.6, 0, h * 0.8), (-r, 0, h * 2.2), (r, 0, h * 2.2), (r * 0.6, 0, h * 0.8)]), 0.07))
    if rng.random() < 0.4:
        parts += [ball(0.1).at(0.5 * r * np.cos(a), 0.5 * r * np.sin(a), -0.04) for a in (0, 2.1, 4.2)]
    return parts


def bucket(rng: Generator) -> list[Solid]:
    """Make a bucket: a tapered pail, its bail fallen to one side, a pouring lip, sometimes a mop or a brush inside."""
    u = rng.uniform
    low, high, h = u(0.6, 0.9), u(0.95, 1.3), u(1.2, 2.2)
    parts = [vessel([(low, 0), (low + (high - low) * 0.93, h * 0.93), (high * 1.05, h * 0.94), (high * 1.05, h)], 0.06)]
    lean = u(20, 85) * rng.choice((-1, 1))
    bail = curve([(0, -high, 0), (0, -high, high * 1.6), (0, high, high * 1.6), (0, high, 0)])
    parts += [
        part.turned("y", lean).at(z=h * 0.93) for part in (tube(bail, 0.04), rod((0, -0.25, high * 1.2), (0, 0.25, high * 1.2), 0.09))
    ]
    parts.append(box(0.35, 0.5, 0.12, 1.3).at(high * 1.1, 0, h * 0.9))
    if rng.random() < 0.6:
        x, y, long = u(-0.5, 0.2), u(0.2, 0.6), u(1.3, 2.2) * h
        parts += [rod((-x * 0.5, -y * 0.5, 0.1), (x, y, long), 0.06), box(0.2, 0.5, 0.25, 0.7).at(x, y, long)]
    return parts + [cylinder(0.12, 0.06).turned("x", 90).at(0, s * high * 0.98, h * 0.93) for s in (-1, 1)]


def saucepan(rng: Generator) -> list[Solid]:
    """Make a saucepan or a frying pan: long handle, sometimes a helper handle, a lid that lies askew."""
    u = rng.uniform
    r, h, long = u(0.8, 1.3), u(0.3, 1.2), u(1.2, 2.4)
    parts = [vessel([(r * u(0.8, 1), 0), (r, h * 0.4), (r, h * 0.95), (r * 1.05, h)], 0.07)]
    rise = u(-0.1, 0.5)
    grip = curve([(r * 0.97, 0, h * 0.8), (r + long * 0.4, 0, h * 0.8), (r + long, 0, h * 0.8 + rise)])
    parts.append(tube(grip, [0.07, 0.07, 0.08, 0.1, 0.12, 0.13, 0.13, 0.13, 0.13, 0.08], 8))
    if rng.random() < 0.5:
        parts += [part.turned("z", 180) for part in _handle(rng, r * 0.97, h * 0.7, h * 0.75, u(0.25, 0.4), wide=0.35)]
    if rng.random() < 0.6:
        lid = [lathe([(r, 0), (r * 0.98, 0.08), (r * 0.5, u(0.15, 0.3)), (0.1, 0.32), (0, 0.33)]), ball(0.13).at(z=0.42)]
        parts += [part.turned("y", -u(0, 30)).at(u(-0.5, 0), u(-0.4, 0.4), h) for part in lid]
    return parts + [box(0.16, 0.25, 0.06).at(0, r, h * 0.97)] * int(rng.random() < 0.5)


def jug(rng: Generator) -> list[Solid]:
    """Make a jug: a slender body, a tall handle, a beak opposite to it."""
    u = rng.uniform
    r, h = u(0.5, 0.8), u(1.5, 2.6)
    neck, mouth = u(0.45, 0.8), u(0.6, 1.0)
    outer = [(r * 0.65, 0), (r, h * u(0.2, 0.45)), (r * (neck + 1) / 2, h * 0.6), (r * neck, h * 0.78), (r * mouth, h)]
    parts = [vessel(outer, 0.05)]
    parts += [part.turned("z", 180) for part in _handle(rng, r * neck * 0.95, h * 0.4, h * u(0.8, 0.95), u(0.5, 0.9))]
    beak = hull([(0, r * mouth * 1.4, -h * 0.2, 0), (r * 0.5, 0.3, -h * 0.07, 0.05), (r * 0.8, 0.12, 0.03, 0.09)], 0.2, 10)
    parts.append(beak.at(r * mouth * 0.7, 0, h))
    if rng.random() < 0.5:
        parts += [cylinder(r * mouth * 0.9, 0.08).at(z=h * 0.98), ball(0.12).at(0, 0, h * 1.05)]
    if rng.random() < 0.4:
        parts.append(lathe([(r * 0.95, 0), (r * 0.7, h * 0.08)]).at(z=-h * 0.06))
    return parts


def watering_can(rng: Generator) -> list[Solid]:
    """Make a watering can: a long spout with a rose, a handle behind or above, a half-covered opening."""
    u = rng.uniform
    r, h, out = u(0.7, 1.0), u(1.0, 1.7), u(1.0, 2.0)
    parts = [vessel([(r, 0), (r * u(0.75, 1.05), h)], 0.05)]
    rise = h * u(0.9, 1.5)
    parts.append(rod((r * 0.85, 0, h * 0.2), (r + out, 0, rise), 0.16, 0.5, 10))
    parts.append(cylinder(0.12, 0.3, u(2, 3.4)).turned("y", u(40, 80)).at(r + out, 0, rise))
    back = curve([(-r * 0.9, 0, h * 0.15), (-r * 2.2, 0, h * 0.5), (-r * 1.6, 0, h * u(1.3, 1.9)), (r * 0.4, 0, h * 1.02)], 14)
    top = curve([(-r * 0.9, 0, h), (-r * 0.5, 0, h * 2.1), (r * 0.6, 0, h * 2.1), (r * 0.8, 0, h)])
    parts.append(tube(back if rng.random() < 0.6 else top, u(0.05, 0.1)))
    parts.append(box(r * 0.7, r * 1.2, 0.06, 0.9).at(r * 0.4, 0, h * 0.97))
    if rng.random() < 0.4:
        parts.append(rod((r * 0.8, 0, h * 0.95), (r + out * 0.6, 0, h * 0.2 + (rise - h * 0.2) * 0.6), 0.04))
    return parts


def bathtub(rng: Generator) -> list[Solid]:
    """Make a bathtub: unequal ends, feet or a plinth, a tap and a hose at one end."""
    u = rng.uniform
    long, width, h, t = u(1.4, 2.0), u(0.65, 0.95), u(0.4, 0.65), u(0.03, 0.06)
    angles = np.arange(24) * (2 * np.pi / 24)
    power = u(0.5, 0.9)
    c, s = (np.sign(f) * np.abs(f) ** power for f in (np.cos(angles), np.sin(angles)))
    sizes = ((0.75, 0.08), (0.9, h * 0.5), (1.0, h), (1.0 - t * 2, h), (0.85, h * 0.5), (0.7, 0.08 + t))
    outline = np.stack([c * (long / 2) * np.where(c > 0, u(0.8, 1), 1), s * width / 2, 0 * c], -1)
    rings = np.stack([outline * (f, f, 0) + (0, 0, z) for f, z in sizes])
    rings[:, :, 2] += u(0, 0.25) * np.maximum(-c, 0) ** 2 * (rings[:, :, 2] / h) ** 2
    parts = [loft(rings)]
    parts += [
        rod((x * long * 0.28, y * width * 0.25, 0.15), (x * long * 0.33, y * width * 0.3, -0.08), 0.05, 0.6)
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    x = long * 0.42
    parts += [rod((x, 0, h * 0.9), (x, 0, h + 0.2), 0.035), rod((x, 0, h + 0.18), (x - 0.2, 0, h + 0.13), 0.03)]
    parts += [ball(0.05).at(x, side * 0.12, h + 0.08) for side in (-1, 1)]
    if rng.random() < 0.5:
        y = rng.choice((-1, 1)) * width * 0.4
        path = curve([(x, 0, h + 0.1), (x, y * 2.4, h + 0.6), (x * 0.6, y * 1.5, h + 0.2), (x * 0.5, y, h + 0.35)], 14)
        parts += [tube(path, 0.02, 6), cylinder(0.07, 0.05).at(*path[-1])]
    return parts


def spray_bottle(rng: Generator) -> list[Solid]:
    """Make a spray bottle: a flattened body, a neck, a head with a nozzle in front and a trigger under it."""
    u = rng.uniform
    r, h, flat = u(0.35, 0.55), u(1.0, 1.8), u(0.6, 1.0)
    body = lathe(
        [(r * 0.95, 0), (r, h * 0.1), (r * u(0.75, 1), h * 0.5), (r * u(0.8, 1), h * 0.75), (0.18, h * 0.97), (0.16, h * 1.08)], 20
    )
    parts = [Solid(body.vertices * (1, flat, 1), body.faces), cylinder(0.2, 0.18).at(z=h)]
    long, z = u(0.5, 0.9), h + 0.2
    parts.append(
        hull(
            [
                (-long * 0.5, 0.15, z + 0.1, z + 0.25),
                (-long * 0.2, 0.25, z, z + 0.4),
                (long * 0.4, 0.22, z + 0.1, z + 0.4),
                (long * 0.7, 0.16, z + 0.18, z + 0.36),
            ]
        )
    )
    parts += [rod((long * 0.65, 0, z + 0.27), (long * 0.85, 0, z + 0.27), 0.06), rod((0, 0, z - 0.2), (0, 0, z + 0.1), 0.12)]
    pull = u(0.2, 0.5)
    parts.append(
        tube(
            curve(
                [
                    (long * 0.35, 0, z + 0.15),
                    (long * 0.45, 0, z - 0.1),
                    (long * 0.3 + pull * 0.5, 0, z - 0.2),
                    (long * 0.4 + pull * 0.4, 0, z - 0.45),
                ]
            ),
            0.06,
        )
    )
    if rng.random() < 0.4:
        parts.append(ring(r * 0.99, 0.04).at(z=h * 0.12))
    return parts


def _handle(rng: Generator, x: float, low: float, high: float, out: float, wide: float = 0.0) -> list[Solid]:
    """A loop on the +x side from height `low` to `high`; `wide` spreads its two roots sideways."""
    square, thick = rng.uniform(0.9, 1.4), rng.uniform(0.05, 0.09)
    path = [(x, -wide, low), (x + out * square, -wide, low + rng.uniform(-0.1, 0.1)), (x + out * square, wide, high), (x, wide, high)]
    return [tube(curve(path, 12), thick)]
