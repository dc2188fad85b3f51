"""Furniture: chair, table, bookshelf, sofa; bed, desk, cabinet, piano. Lengths in metres."""

from __future__ import annotations

import itertools

from numpy.random import Generator

from cmig_jax.data.solids import Solid, ball, box, cylinder, plate, rod


def chair(rng: Generator) -> list[Solid]:
    """Make a chair: legs or a star base, a seat, a back of one of three kinds, arms or none."""
    u = rng.uniform
    depth, width, height, t, tall = u(0.38, 0.55), u(0.38, 0.6), u(0.35, 0.55), u(0.03, 0.1), u(0.25, 0.7)
    parts = [box(depth, width, t, u(0.85, 1)).at(z=height)]
    if rng.random() < 0.7:
        parts += _legs(rng, depth / 2 - 0.03, width / 2 - 0.03, height, u(0.015, 0.04))
    else:
        parts.append(cylinder(u(0.03, 0.05), height))
        parts += [rod((0, 0, 0.06), (0.3, 0, 0.02), 0.03, 0.6).turned("z", 72 * i + 10) for i in range(5)]
    back = [box(0.04, width, tall)]
    kind = rng.integers(3)
    if kind:
        posts = [rod((0, s * (width / 2 - 0.03), 0), (0, s * (width / 2 - 0.03), tall), 0.025) for s in (-1, 1)]
        bars = int(rng.integers(2, 6))
        if kind == 1:
            slots = [box(0.03, width / bars * 0.45, tall).at(y=width * ((i + 0.5) / bars - 0.5)) for i in range(bars)]
            back = [*posts, *slots, box(0.04, width, 0.07).at(z=tall - 0.04)]
        else:
            back = [*posts, *(box(0.03, width, tall / bars * u(0.3, 0.6)).at(z=tall * (i + 0.5) / bars) for i in range(bars))]
    lean = u(-20, -2)
    parts += [part.turned("y", lean).at(-depth / 2 + 0.02, 0, height + t / 2) for part in back]
    if rng.random() < 0.45:
        for s in (-1, 1):
            parts.append(box(depth * 0.9, 0.05, 0.03).at(0, s * width / 2, height + 0.24))
            parts.append(rod((depth * 0.35, s * width / 2, height), (depth * 0.35, s * width / 2, height + 0.25), 0.02))
    return parts


def table(rng: Generator) -> list[Solid]:
    """Make a table: four legs or trestles, a drawer at one end, a shelf below, things left on top."""
    u = rng.uniform
    length, width, height, t = u(0.8, 1.8), u(0.5, 1.0), u(0.4, 0.9), u(0.03, 0.08)
    parts = [box(length, width, t, u(0.96, 1.04)).at(z=height)]
    if rng.random() < 0.65:
        parts += _legs(rng, length / 2 - 0.07, width / 2 - 0.07, height, u(0.025, 0.05))
    else:
        parts += [box(0.06, width * u(0.5, 0.9), height, u(0.5, 1)).at(x=s * length * 0.38) for s in (-1, 1)]
        parts.append(rod((-length * 0.38, 0, height * 0.4), (length * 0.38, 0, height * 0.4), 0.03))
    drawer = u(0.25, 0.45) * length
    parts.append(box(drawer, width * 0.8, u(0.1, 0.2)).at(x=length * 0.45 - drawer / 2, z=height - 0.1))
    parts.append(ball(0.03).at(length * 0.45 - drawer / 2, width * 0.42, height - 0.03))
    if rng.random() < 0.5:
        parts.append(box(length * u(0.3, 0.6), width * 0.8, 0.03).at(x=-length * u(0.1, 0.2), z=height * u(0.2, 0.5)))
    for _ in range(int(rng.integers(0, 4))):
        x, y = u(-0.4, 0.4) * length, u(-0.35, 0.35) * width
        item = box(u(0.1, 0.3), u(0.08, 0.2), u(0.03, 0.2)) if rng.random() < 0.5 else cylinder(u(0.04, 0.1), u(0.05, 0.3), u(0.6, 1.3))
        parts.append(item.at(x, y, height + t))
    return parts


def bookshelf(rng: Generator) -> list[Solid]:
    """Make a bookshelf: boards at uneven heights, a divider, rows of books that do not fill it."""
    u = rng.uniform
    depth, width, height, t = u(0.25, 0.4), u(0.5, 1.2), u(0.8, 2.0), u(0.02, 0.04)
    parts = [box(depth, t, height).at(y=s * width / 2) for s in (-1, 1)]
    if rng.random() < 0.7:
        parts.append(box(0.015, width, height).at(x=-depth / 2))
    shelves = int(rng.integers(2, 6))
    levels = [height * (i + u(-0.15, 0.15) * (0 < i < shelves)) / shelves for i in range(shelves + 1)]
    parts += [box(depth, width, t).at(z=z) for z in levels]
    for low, high in itertools.pairwise(levels):
        y, end, full = -width / 2 + 0.03, width * u(-0.3, 0.45), (high - low) * u(0.55, 0.9)
        while y < end:
            thick = u(0.04, 0.1)
            parts.append(box(depth * u(0.6, 0.95), thick * 0.9, full * u(0.75, 1)).at(0, y + thick / 2, low + t))
            y += thick
    if rng.random() < 0.4:
        level = int(rng.integers(shelves))
        parts.append(box(depth, t, levels[level + 1] - levels[level]).at(y=width * u(0.1, 0.4), z=levels[level]))
    return parts


def sofa(rng: Generator) -> list[Solid]:
    """Make a sofa: arms, back, seat and back cushions, and mostly a chaise on one side."""
    u = rng.uniform
    depth, width, seat, arm = u(0.7, 0.95), u(1.0, 2.3), u(0.25, 0.42), u(0.1, 0.25)
    tall, count = seat + u(0.3, 0.55), int(rng.integers(1, 4))
    parts = [box(depth, width, seat * 0.8).at(z=0.08), box(0.2, width, tall, u(0.7, 1)).at(x=-depth / 2 + 0.1, z=0.05)]
    for s in (-1, 1):
        raised = seat + u(0.1, 0.28)
        parts.append(box(depth, arm, raised).at(0, s * (width + arm) / 2, 0.05))
        if rng.random() < 0.5:
            parts.append(
                rod((-depth / 2, s * (width + arm) / 2, raised), (depth / 2, s * (width + arm) / 2, raised), arm * 0.6, sections=12)
            )
    for i in range(count):
        y = width * ((i + 0.5) / count - 0.5)
        parts.append(box(depth * 0.8, width / count * 0.95, 0.14, 0.92).at(0.06, y, seat))
        if rng.random() < 0.8:
            parts.append(box(0.14, width / count * 0.85, 0.38, 0.85).turned("y", -12).at(-depth / 2 + 0.27, y, seat + 0.1))
    if rng.random() < 0.7:
        s = rng.choice((-1, 1))
        parts.append(box(u(0.4, 0.8), width * u(0.3, 0.45), seat + 0.1).at(depth * 0.7, s * width * 0.3, 0.04))
    return parts + [cylinder(0.03, 0.1).at(x * depth * 0.42, y * width * 0.45) for x in (-1, 1) for y in (-1, 1)]


def bed(rng: Generator) -> list[Solid]:
    """Make a bed: head and foot boards of unequal height, mattress, pillows, a folded blanket."""
    u = rng.uniform
    length, width, height, t = u(1.7, 2.1), u(0.8, 1.8), u(0.2, 0.45), u(0.12, 0.3)
    tall = height + u(0.35, 0.9)
    parts = [box(length, width, 0.1).at(z=height - 0.1), box(length * 0.98, width * 0.95, t, 0.97).at(z=height)]
    parts.append(box(0.06, width, tall, u(0.7, 1)).at(x=-length / 2))
    if rng.random() < 0.6:
        parts.append(box(0.05, width, height + u(0.1, 0.3)).at(x=length / 2))
    parts += _legs(rng, length / 2 - 0.05, width / 2 - 0.05, height, u(0.03, 0.06))
    count = int(rng.integers(1, 3))
    for i in range(count):
        parts.append(ball(0.2, width / count * u(0.3, 0.42), 0.09).at(-length * 0.36, width * ((i + 0.5) / count - 0.5), height + t + 0.03))
    cover = u(0.3, 0.6) * length
    parts.append(box(cover, width * 1.03, t * u(0.5, 0.9)).at(length / 2 - cover / 2, 0, height + t * 0.3))
    if rng.random() < 0.5:
        parts.append(box(0.4, 0.4, height + u(0, 0.2)).at(-length * 0.4, rng.choice((-1, 1)) * (width / 2 + 0.25)))
    return parts


def desk(rng: Generator) -> list[Solid]:
    """Make a desk: drawers under one side, a panel or legs under the other, a screen, lamp or hutch on top."""
    u = rng.uniform
    depth, width, height, t, s = u(0.5, 0.8), u(1.0, 1.8), u(0.65, 0.8), u(0.03, 0.06), rng.choice((-1, 1))
    body = u(0.3, 0.5)
    parts = [box(depth, width, t).at(z=height), box(depth * 0.9, body, height * u(0.7, 1)).at(y=s * (width - body) / 2, z=0.05)]
    drawers = int(rng.integers(2, 5))
    for i in range(drawers):
        z = 0.1 + (height - 0.1) * i / drawers
        parts.append(box(0.03, body * 0.9, (height - 0.1) / drawers * 0.85).at(depth * 0.46, s * (width - body) / 2, z))
        parts.append(box(0.03, body * 0.35, 0.02).at(depth * 0.49, s * (width - body) / 2, z + 0.08))
    if rng.random() < 0.5:
        parts.append(box(depth * 0.9, 0.04, height).at(y=-s * (width / 2 - 0.04)))
    else:
        parts += [rod((x * depth * 0.42, -s * width * 0.46, 0), (x * depth * 0.42, -s * width * 0.46, height), 0.03) for x in (-1, 1)]
    if rng.random() < 0.5:
        y = u(-0.25, 0.25) * width
        parts += [
            box(0.03, u(0.4, 0.7), u(0.25, 0.4)).turned("y", -8).at(-depth * 0.2, y, height + 0.12),
            cylinder(0.1, 0.15, 0.2).at(-depth * 0.2, y, height),
        ]
    else:
        tall = u(0.25, 0.5)
        parts += [box(depth * 0.35, width * 0.6, 0.03).at(-depth * 0.3, s * width * 0.2, height + tall)]
        parts += [box(depth * 0.35, 0.03, tall).at(-depth * 0.3, s * width * (0.2 + f * 0.3), height) for f in (-1, 1)]
    return parts


def cabinet(rng: Generator) -> list[Solid]:
    """Make a cabinet: a column of drawers beside a door that may stand open."""
    u = rng.uniform
    depth, width, height, split = u(0.35, 0.6), u(0.6, 1.3), u(0.6, 1.6), u(0.35, 0.65)
    parts = [box(depth, width, height).at(z=0.1), box(depth * 1.06, width * 1.06, 0.04).at(z=height + 0.1)]
    drawers, column = int(rng.integers(2, 6)), width * split
    for i in range(drawers):
        out = u(0.1, 0.6) * depth if rng.random() < 0.25 else 0.03
        z, y = 0.12 + height * i / drawers, -width / 2 + column / 2
        parts.append(box(out, column * 0.92, height / drawers * 0.86).at(depth / 2 + out / 2, y, z))
        parts.append(ball(0.025).at(depth / 2 + out + 0.015, y, z + height / drawers * 0.45))
    wide = width - column
    swing = 0.0 if rng.random() < 0.5 else u(20, 110)
    door = [box(0.03, wide * 0.94, height * 0.96).at(0, -wide / 2, 0), box(0.05, 0.03, 0.15).at(0.03, -wide * 0.85, height * 0.45)]
    parts += [part.turned("z", swing).at(depth / 2 + 0.02, width / 2, 0.12) for part in door]
    if rng.random() < 0.5:
        parts.append(box(0.03, width, u(0.1, 0.4), u(0.6, 1)).at(-depth / 2 + 0.02, 0, height + 0.12))
    return parts + [
        rod((x * depth * 0.4, y * width * 0.43, 0.12), (x * depth * 0.44, y * width * 0.46, 0), 0.03) for x in (-1, 1) for y in (-1, 1)
    ]


def piano(rng: Generator) -> list[Solid]:
    """Make a piano, upright or grand, with keys, pedals, and mostly a stool pulled to one side."""
    u = rng.uniform
    width, key = u(1.2, 1.6), u(0.65, 0.75)
    parts = [box(0.25, width, 0.1).at(x=0.35, z=key), box(0.13, width * 0.9, 0.03).at(x=0.4, z=key + 0.1)]
    if rng.random() < 0.5:
        tall = u(1.0, 1.35)
        parts += [box(u(0.35, 0.5), width, tall), box(0.04, width * 0.5, 0.25).turned("y", -15).at(0.2, 0, key + 0.15)]
        parts += [rod((0.42, s * width * 0.46, 0), (0.42, s * width * 0.46, key), 0.04) for s in (-1, 1)]
    else:
        long, h = u(1.0, 1.8), width / 2
        outline = [(0.3, -h), (0.3, h), (-long * 0.3, h), (-long * 0.6, h * 0.4), (-long * 0.9, 0), (-long, -h * 0.5), (-long * 0.9, -h)]
        parts.append(plate(outline, u(0.2, 0.3)).at(z=key - 0.05))
        lid = plate([(x, y + h) for x, y in outline], 0.03).turned("x", u(20, 45)).at(0, -h, key + 0.26)
        parts += [lid] if rng.random() < 0.7 else []
        parts += [rod((x, y, key), (x, y, 0), 0.06, 0.6) for x, y in ((0.25, -h * 0.85), (0.25, h * 0.85), (-long * 0.75, -h * 0.5))]
    if rng.random() < 0.6:
        seat = cylinder(0.18, 0.08) if rng.random() < 0.5 else box(0.3, 0.6, 0.08)
        x, y = u(0.7, 0.9), u(-0.3, 0.3)
        parts += [seat.at(x, y, 0.45), cylinder(0.12, 0.45, 0.4).at(x, y)]
    parts.append(box(0.06, 0.3, key).at(x=0.37))
    return parts + [box(0.15, 0.03, 0.02).at(0.45, 0.08 * i, 0.05) for i in (-1, 0, 1)]


def _legs(rng: Generator, x: float, y: float, height: float, thick: float) -> list[Solid]:
    splay, taper, sections = rng.uniform(0, 0.12) * height, rng.uniform(0.5, 1.2), int(rng.choice((4, 8)))
    corners = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    return [rod((a * x, b * y, height), (a * (x + splay), b * (y + splay), 0), thick, taper, sections) for a, b in corners]
