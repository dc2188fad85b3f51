"""Fittings: tap, valve, bracket, hook; hinge, door handle, shower, wall lamp. Lengths in decimetres."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from cmig_jax.data.solids import Solid, ball, box, curve, cylinder, lathe, plate, ring, rod, tube, vessel


def tap(rng: Generator) -> list[Solid]:
    """Make a tap: a base, a bent or straight spout, one lever or two unequal knobs."""
    u = rng.uniform
    r, h, out = u(0.15, 0.3), u(0.4, 1.6), u(0.7, 1.6)
    parts = [cylinder(r * u(1.3, 2), 0.1), cylinder(r, h * 0.8, u(0.7, 1.1))]
    over = h + u(0.2, 0.8)
    path = [(0, 0, h * 0.6), (0, 0, over * 1.2), (out, 0, over * 1.2), (out, 0, over * u(0.4, 0.8))]
    if rng.random() < 0.4:
        path = [(0, 0, h * 0.65), (out * 0.5, 0, h * 0.8), (out, 0, h * u(0.6, 1.1))]
    parts.append(tube(curve(path, 14), r * u(0.5, 0.8), 10))
    if rng.random() < 0.5:
        up, side = u(0, 60), rng.choice((-1, 1))
        lever = [rod((0, 0, 0), (0, 0.5, 0), 0.09), rod((0, 0.5, 0), (u(0.2, 0.5), 0.55, 0.4), 0.06, 1.5)]
        parts += [Solid(p.vertices * (1, side, 1), p.faces if side > 0 else p.faces[:, ::-1]).turned("y", -up).at(z=h * 0.4) for p in lever]
    else:
        wide = u(0.4, 0.8)
        parts.append(rod((0, -wide, 0.25), (0, wide, 0.25), 0.1))
        for s, turn in ((-1, u(0, 90)), (1, u(0, 90))):
            parts += [
                cylinder(0.13, u(0.25, 0.5)).at(0, s * wide, 0.2),
                rod((-0.25, 0, 0), (0.25, 0, 0), 0.06).turned("z", turn).at(0, s * wide, 0.5),
            ]
    return parts


def valve(rng: Generator) -> list[Solid]:
    """Make a valve: a bent or straight pipe run with flanges of two sizes, a branch, a hand wheel or a lever."""
    u = rng.uniform
    r, left, right = u(0.2, 0.35), u(0.6, 1.4), u(0.6, 1.4)
    bend = u(-80, 80)
    end = right * np.array([np.cos(np.radians(bend)), np.sin(np.radians(bend)), 0])
    parts = [
        tube(np.concatenate([[(-left, 0, 0)], curve([(-0.3, 0, 0), (0, 0, 0), end / right * 0.3], 6), [end]]), r, 14),
        ball(r * u(1.3, 1.8)),
    ]
    parts.append(cylinder(r * u(1.5, 2), 0.15).turned("y", 90).at(x=-left))
    parts.append(cylinder(r * u(1.3, 1.8), 0.15).turned("y", 90).turned("z", bend).at(*end))
    h, lean = u(0.7, 1.3), u(-25, 25)
    top = [cylinder(r * 0.7, h * 0.6), rod((0, 0, 0), (0, 0, h), 0.08)]
    if rng.random() < 0.55:
        wheel = u(0.35, 0.6)
        top += [ring(wheel, 0.06).at(z=h), *(rod((0, 0, h), (wheel, 0, h), 0.045).turned("z", 120 * i + 15) for i in range(3))]
    else:
        top.append(box(u(0.8, 1.4), 0.18, 0.07).at(x=0.5, z=h).turned("z", u(0, 180)))
    parts += [p.turned("x", lean) for p in top]
    if rng.random() < 0.5:
        parts += [
            rod((-left * 0.55, 0, 0), (-left * 0.55, u(0.5, 0.9), 0), r * 0.6, sections=12),
            rod((-left * 0.55, 0, 0), (-left * 0.55, 0, -u(0.4, 0.8)), r * 0.4),
        ]
    return parts


def bracket(rng: Generator) -> list[Solid]:
    """Make a bracket: two unequal arms, a gusset or a stay off centre, bolts, a lip, sometimes the board it carries."""
    u = rng.uniform
    long, tall, width, t = u(0.8, 2.0), u(0.7, 1.6), u(0.3, 0.9), u(0.05, 0.12)
    parts = [box(long, width, t).at(x=long / 2), box(t, width * u(0.7, 1.2), tall).at(z=-tall + t)]
    y = u(-0.3, 0.3) * width
    if rng.random() < 0.5:
        gusset = plate([(0, 0), (long * u(0.5, 0.9), 0), (0, tall * u(0.5, 0.9))], t).turned("x", -90)
        parts.append(gusset.at(0, y, t / 2))
    else:
        bow = curve([(long * 0.85, y, 0), (long * 0.5, y, -tall * u(0, 0.5)), (0.05, y, -tall * 0.85)])
        parts.append(tube(bow, u(0.04, 0.08)))
    if rng.random() < 0.6:
        parts.append(box(t, width, u(0.1, 0.4)).at(x=long, z=0))
    bolts = int(rng.integers(1, 4))
    parts += [cylinder(0.08, 0.12).turned("y", -90).at(0, u(-0.3, 0.3) * width, -tall * (i + 0.7) / (bolts + 0.7)) for i in range(bolts)]
    parts += [cylinder(0.07, 0.1).at(long * (i + 0.6) / (bolts + 0.5), u(-0.3, 0.3) * width, t) for i in range(bolts)]
    if rng.random() < 0.3:
        parts.append(box(long * 1.1, width * u(1.5, 2.5), 0.08).at(long * 0.55, u(-0.3, 0.3), t))
    return parts


def hook(rng: Generator) -> list[Solid]:
    """Make a coat hook on its plate: a large and a small hook, or a row of hooks of which some hold something."""
    u = rng.uniform
    count, tall = int(rng.integers(1, 5)), u(0.6, 1.1)
    width = 0.45 * count
    parts = [box(0.08, width, tall, u(0.8, 1)).at(x=-0.04, z=-tall / 2)]
    for i in range(count):
        y, out, up, r = 0.45 * (i + 0.5) - width / 2, u(0.4, 0.8), u(0.1, 0.5), u(0.04, 0.08)
        path = curve([(0, y, -tall * 0.2), (out, y, -tall * 0.8), (out * 1.4, y, -tall * 0.2), (out * 0.9, y, up)], 10)
        parts += [tube(path, np.linspace(r * 1.3, r, 10)), ball(r * 1.5).at(*path[-1])]
        if rng.random() < 0.6:
            parts.append(tube(curve([(0, y, tall * 0.1), (out * 0.6, y, tall * 0.2), (out * 0.6, y, tall * u(0.5, 0.9))], 8), r))
        if rng.random() < 0.35:
            size = u(0.2, 0.4)
            parts += [ring(size, 0.04, "x" if rng.random() < 0.5 else "y").at(out * 0.7, y, -tall * 0.3 - size)]
    if rng.random() < 0.4:
        parts.append(box(u(0.3, 0.6), width * 1.1, 0.06).at(0.15, 0, tall * 0.5))
    return parts


def hinge(rng: Generator) -> list[Solid]:
    """Make a hinge: two unequal leaves at some angle, knuckles, a pin with a head, screws."""
    u = rng.uniform
    tall, opening = u(0.8, 1.8), u(35, 200)
    r, t, knuckles = u(0.07, 0.13), u(0.04, 0.08), int(rng.integers(3, 7))
    parts = [cylinder(r, tall / knuckles * 0.92).at(z=tall * i / knuckles) for i in range(knuckles)]
    parts += [rod((0, 0, -0.1), (0, 0, tall + u(0.05, 0.3)), r * 0.6), ball(r * 1.2, r * 1.2, r * 0.8).at(z=tall + 0.1)]
    for angle in (0.0, opening):
        wide, high = u(0.4, 1.4), tall * u(0.7, 1)
        leaf = [box(wide, t, high, u(0.6, 1)).at(x=wide / 2)]
        screws = int(rng.integers(1, 4))
        leaf += [cylinder(0.07, 0.07).turned("x", -90).at(wide * u(0.4, 0.7), 0, high * (i + 0.5) / screws) for i in range(screws)]
        if rng.random() < 0.35:
            leaf.append(box(t * 1.5, u(0.15, 0.5), high * 0.8).at(wide, 0.1, high * 0.1))
        parts += [part.at(z=u(0, 0.02) * tall).turned("z", angle) for part in leaf]
    return parts


def door_handle(rng: Generator) -> list[Solid]:
    """Make a door handle: a plate or a rose, a bent lever to one side, a keyhole cover, a key or a thumb turn."""
    u = rng.uniform
    tall, width, out, long, s = u(1.2, 2.4), u(0.35, 0.55), u(0.35, 0.6), u(0.9, 1.5), rng.choice((-1, 1))
    parts = [box(0.08, width, tall, u(0.85, 1)).at(x=-0.04, z=-tall * 0.6)]
    if rng.random() < 0.4:
        parts = [cylinder(width * 0.6, 0.1).turned("y", 90), cylinder(width * 0.5, 0.1).turned("y", 90).at(z=-tall * 0.4)]
    drop, r = u(-0.35, 0.2), u(0.06, 0.11)
    parts.append(rod((0, 0, 0), (out * 0.8, 0, 0), r * 1.3, sections=12))
    path = curve([(out * 0.4, 0, 0), (out * 1.3, 0, 0), (out, s * long * 0.5, u(-0.1, 0.1)), (out * u(0.6, 1.1), s * long, drop)], 12)
    parts.append(tube(path, np.linspace(r, r * u(0.7, 1.6), 12), 10))
    z = -tall * 0.4
    if rng.random() < 0.6:
        parts += [rod((0, 0, z), (0.4, 0, z), 0.03), ring(u(0.1, 0.18), 0.03, "y").at(0.5, 0, z), box(0.3, 0.03, 0.2).at(0.5, 0, z - 0.3)]
    else:
        parts += [cylinder(0.12, 0.15).turned("y", 90).at(z=z), box(0.08, u(0.2, 0.4), 0.1).turned("x", u(0, 90)).at(0.18, 0, z)]
    if rng.random() < 0.4:
        parts += [
            box(0.35, width * 0.6, tall * 0.5).at(-0.2, s * width * 0.1, -tall * 0.5),
            box(0.1, 0.6, 0.2).at(-0.2, -s * width * 0.4, -0.15),
        ]
    return parts


def shower(rng: Generator) -> list[Solid]:
    """Make a shower: a rail or an arm, a tilted head, a hose in a loop, a mixer with one lever."""
    u = rng.uniform
    tall, out, head = u(2.0, 3.2), u(0.5, 1.3), u(0.25, 0.55)
    parts = [
        rod((0, 0, 0), (0, 0, tall), 0.06),
        rod((-0.25, 0, 0.1), (0, 0, 0.1), 0.06),
        rod((-0.25, 0, tall * 0.9), (0, 0, tall * 0.9), 0.06),
    ]
    neck = curve([(0, 0, tall), (0, 0, tall + 0.4), (out, 0, tall + 0.5), (out, 0, tall + u(-0.1, 0.2))], 10)
    parts += [tube(neck, 0.055), lathe([(0.08, 0.25), (head, 0.08), (head, 0)], 20).turned("y", -u(0, 35)).at(*(neck[-1] - (0, 0, 0.2)))]
    side = rng.choice((-1, 1))
    parts += [
        rod((0, -0.5, 0.3), (0, 0.5, 0.3), u(0.1, 0.16), sections=12),
        rod((0, side * 0.5, 0.3), (u(0.2, 0.5), side * 0.6, u(0.3, 0.7)), 0.06),
    ]
    if rng.random() < 0.7:
        z = tall * u(0.4, 0.8)
        path = curve([(0.05, -side * 0.3, 0.3), (0.4, -side * 1.6, -1.4), (0.6, -side * 0.6, z - 0.8), (0.25, -side * 0.1, z)], 20)
        parts += [tube(path, 0.035, 6), rod((0.1, -side * 0.1, z - 0.2), (0.4, -side * 0.1, z + 0.4), 0.06, 1.4)]
        parts.append(cylinder(u(0.18, 0.28), 0.1).turned("y", 70).at(0.35, -side * 0.1, z + 0.45))
    if rng.random() < 0.5:
        parts.append(box(0.35, u(0.5, 0.9), 0.05).at(0.1, side * 0.2, tall * u(0.25, 0.5)))
    return parts


def wall_lamp(rng: Generator) -> list[Solid]:
    """Make a lamp on an arm of one to three links, from a wall plate or a foot, with a turned shade and its bulb."""
    u = rng.uniform
    parts = [cylinder(u(0.3, 0.5), 0.12).turned("y", 90)] if rng.random() < 0.5 else [box(u(0.6, 1.0), u(0.4, 0.8), 0.1).at(-0.2, 0, -0.1)]
    joint = np.array([0.05, 0.0, 0.05])
    for _ in range(int(rng.integers(1, 4))):
        step = np.array([u(-0.2, 0.9), u(-0.5, 0.5), u(0.5, 1.1)]) * u(0.8, 1.3)
        parts += [rod(joint, joint + step, u(0.04, 0.07)), ball(0.1).at(*(joint + step))]
        joint = joint + step
    r, h, wall = u(0.3, 0.55), u(0.4, 0.8), 0.04
    lean, turn = u(110, 200), u(-60, 60)
    shade = [
        vessel([(r * u(0.3, 0.6), 0), (r * u(0.7, 1), h * 0.5), (r, h)], wall, 20),
        ball(0.16, 0.16, 0.22).at(z=h * 0.5),
        cylinder(0.13, 0.2).at(z=-0.15),
    ]
    parts += [part.turned("y", lean).turned("z", turn).at(*joint) for part in shade]
    if rng.random() < 0.5:
        drop = curve([joint, joint + np.array([0.1, u(0.4, 0.8), -0.6]), (0.0, u(0.3, 0.5), -0.6)], 12)
        parts.append(tube(drop, 0.025, 6))
    return parts
