"""Vehicles on land: car, truck; bicycle, tractor, locomotive. Lengths in metres; x is the direction of travel."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from cmig_jax.data.solids import Solid, ball, box, cylinder, hull, lathe, ring, rod


def car(rng: Generator) -> list[Solid]:
    """Make a car: saloon, estate, van or pick-up by its roof line; mirrors, spoiler or roof box."""
    u = rng.uniform
    long, width, low, belt = u(3.4, 5.0), u(1.6, 2.0), u(0.2, 0.4), u(0.75, 1.0)
    front, rear = long / 2, -long / 2
    body = [(rear, width * 0.85, low + 0.1, belt * u(0.8, 1)), (rear * 0.9, width, low, belt), (0, width, low, belt)]
    parts = [
        hull(
            [
                *body,
                (front * 0.5, width, low, belt),
                (front * 0.9, width * 0.95, low, belt * u(0.8, 1)),
                (front, width * 0.8, low + 0.1, belt * 0.75),
            ],
            0.7,
        )
    ]
    roof, start, stop = belt + u(0.35, 0.9), rear * u(0.1, 0.95), front * u(0.05, 0.4)
    slope = u(0.1, 0.7)
    cabin = [(start - slope * 0.4, width * 0.85, belt * 0.9, belt), (start, width * 0.8, belt * 0.9, roof)]
    parts.append(hull([*cabin, (stop, width * 0.78, belt * 0.9, roof), (stop + slope, width * 0.85, belt * 0.9, belt)], 0.7))
    wheel = u(0.28, 0.42)
    parts += [_wheel(wheel, 0.22).at(x * long, s * width * 0.47, wheel) for x in (-u(0.27, 0.33), u(0.29, 0.34)) for s in (-1, 1)]
    parts += [ball(0.08, 0.12, 0.08).at(stop + 0.1, s * width * 0.55, belt + 0.1) for s in (-1, 1)]
    if rng.random() < 0.35:
        parts.append(box(0.3, width * 0.8, 0.05).at(rear * 0.93, 0, belt + 0.25))
        parts += [box(0.08, 0.05, 0.3).at(rear * 0.93, s * width * 0.3, belt - 0.03) for s in (-1, 1)]
    if rng.random() < 0.35:
        parts.append(box((stop - start) * u(0.5, 0.9), width * 0.5, 0.2, 0.9).at((start + stop) / 2, u(-0.2, 0.2), roof - 0.02))
    return parts


def truck(rng: Generator) -> list[Solid]:
    """Make a truck: a cab before a box, a tank, a tipper or a flat bed with crates; two to four axles."""
    u = rng.uniform
    long, width, wheel, cab = u(3.5, 7), u(1.8, 2.3), u(0.4, 0.5), u(1.1, 1.6)
    deck, tall = wheel * 2 + 0.1, u(1.3, 2.1)
    front = long / 2
    parts = [
        box(long + cab, width * 0.5, 0.2).at(cab / 2, 0, deck - 0.2),
        box(cab, width, tall, u(0.8, 1)).at(front + cab / 2 + 0.1, 0, deck - 0.3),
    ]
    if rng.random() < 0.5:
        parts.append(box(u(0.5, 1), width * 0.8, tall * 0.5, 0.9).at(front + cab + 0.4, 0, deck - 0.3))
    kind = rng.integers(4)
    if kind == 0:
        parts.append(box(long * 0.97, width, tall * u(0.9, 1.4)).at(0, 0, deck))
    elif kind == 1:
        parts.append(rod((-front, 0, deck + 0.8), (front * 0.93, 0, deck + 0.8), u(0.7, 0.95), sections=20))
        parts.append(cylinder(0.3, 0.2).at(u(-0.3, 0.3) * long, 0, deck + 1.6))
    elif kind == 2:
        parts.append(box(long * 0.95, width, u(0.5, 0.9), 1.08).at(long * 0.47, 0, 0).turned("y", -u(5, 40)).at(-front, 0, deck))
    else:
        parts.append(box(long, width, 0.12).at(0, 0, deck))
        spots = (np.arange(3) + 0.5) / 3 - 0.5
        parts += [
            box(long * u(0.15, 0.3), width * u(0.4, 0.9), u(0.3, 1.2)).at(s * long, u(-0.2, 0.2), deck + 0.1)
            for s in spots
            if rng.random() < 0.7
        ]
    axles = [front + cab * 0.4, *np.linspace(-front * 0.8, -front * u(0.3, 0.6), int(rng.integers(1, 4)))]
    parts += [rod((x, -width * 0.4, wheel), (x, width * 0.4, wheel), 0.1) for x in axles]
    return parts + [_wheel(wheel, 0.3).at(x, s * width * 0.45, wheel) for x in axles for s in (-1, 1)]


def bicycle(rng: Generator) -> list[Solid]:
    """Make a bicycle: diamond or step-through frame, bars turned a little, basket, rack or mudguards; one crank arm forward."""
    u = rng.uniform
    r, base, seat, tyre = u(0.26, 0.36), u(0.95, 1.2), u(0.75, 0.95), u(0.015, 0.035)
    hub, crank, head = np.array([-base / 2, 0, r]), np.array([-0.07, 0, r * 0.85]), np.array([base * 0.36, 0, u(0.68, 0.82)])
    saddle = np.array([-0.2, 0, seat])
    joint = crank + (saddle - crank) * u(0.4, 0.85)
    front = np.array([base / 2, 0, r])
    tubes = [(hub, crank), (hub, joint), (crank, saddle), (crank, head - (0, 0, 0.1)), (joint, head), (head, front)]
    parts = [rod(a, b, u(0.014, 0.025), sections=6) for a, b in tubes]
    for centre in (hub, front):
        parts += [ring(r, tyre, "y", 6).at(*centre), rod((0, -0.05, 0), (0, 0.05, 0), 0.03).at(*centre)]
        parts += [rod((0, 0, -r), (0, 0, r), 0.004, sections=4).turned("y", 45 * i).at(*centre) for i in range(4)]
    parts.append(hull([(-0.13, 0.15, 0, 0.05), (0, 0.1, 0.01, 0.05), (0.13, 0.03, 0.0, 0.04)], 0.2, 10).at(*saddle))
    rise, reach = u(0.05, 0.2), u(-0.15, 0.15)
    bars = [rod((0, 0, -0.05), (0, 0, rise), 0.016), *(rod((0, 0, rise), (reach, s * u(0.2, 0.3), rise), 0.018) for s in (-1, 1))]
    turn = u(-25, 25)
    parts += [part.turned("z", turn).at(*head) for part in bars]
    for s in (-1, 1):
        parts.append(rod((0, 0.08 * s, 0), (0.14 * s, 0.08 * s, 0.06 * s), 0.012).at(*crank))
        parts.append(box(0.08, 0.08, 0.02).at(0.14 * s, 0.13 * s, 0.06 * s).at(*crank))
    parts.append(cylinder(0.09, 0.01).turned("x", 90).at(crank[0], -0.04, crank[2]))
    if rng.random() < 0.45:
        parts.append(box(0.25, 0.3, 0.2, 1.2).at(head[0] + 0.22, 0, head[2] - 0.05))
    if rng.random() < 0.45:
        parts += [
            box(0.35, 0.14, 0.02).at(-base / 2, 0, r * 2 + 0.05),
            rod((-base / 2, 0.06, r), (-base / 2 - 0.1, 0.06, r * 2 + 0.05), 0.01),
        ]
    return parts


def tractor(rng: Generator) -> list[Solid]:
    """Make a tractor: large rear and small front wheels, bonnet, cab or roll bar, exhaust on one side, a loader or a plough."""
    u = rng.uniform
    big, small, width, long = u(0.65, 0.9), u(0.3, 0.5), u(1.3, 1.8), u(1.5, 2.3)
    parts = [_wheel(big, u(0.3, 0.5)).at(0, s * width / 2, big) for s in (-1, 1)]
    parts += [_wheel(small, u(0.18, 0.3)).at(long, s * width * 0.42, small) for s in (-1, 1)]
    top = big * 1.5
    parts += [
        box(long * 0.8, width * 0.4, top * 0.55, u(0.8, 1)).at(long * 0.65, 0, top * 0.5),
        box(long * 1.1, width * 0.3, 0.3).at(long * 0.5, 0, small),
    ]
    parts += [rod((long, -width * 0.42, small), (long, width * 0.42, small), 0.08), rod((0, -width / 2, big), (0, width / 2, big), 0.12)]
    side = rng.choice((-1, 1))
    parts += [
        rod((long * 0.6, side * 0.2, top), (long * 0.6, side * 0.2, top + u(0.4, 0.8)), 0.05),
        rod((0.3, 0, top), (0.5, 0, top + 0.3), 0.03),
    ]
    parts += [box(0.4, width * 0.35, 0.1).at(-0.1, 0, top), box(0.08, width * 0.35, 0.4).at(-0.3, 0, top)]
    if rng.random() < 0.6:
        parts.append(box(1.0, width * 0.75, 0.08).at(0, 0, top + 0.95))
        parts += [rod((x, s * width * 0.33, top * 0.8), (x, s * width * 0.33, top + 1), 0.04) for x in (-0.4, 0.4) for s in (-1, 1)]
    if rng.random() < 0.5:
        lift = u(0.1, 1.2)
        parts.append(box(0.5, width, 0.5, u(0.6, 1)).at(long + 0.9, 0, lift))
        parts += [rod((long * 0.3, s * width * 0.3, top * 0.8), (long + 0.75, s * width * 0.3, lift + 0.25), 0.05) for s in (-1, 1)]
    if rng.random() < 0.5:
        parts += [rod((-0.3, 0, big), (-1.1, u(-0.1, 0.1), 0.6), 0.07), box(0.12, width * 1.1, 0.12).at(-1.1, 0, 0.5)]
        parts += [box(0.15, 0.06, 0.5, 1.5).at(-1.1, y * width, 0.05) for y in (-0.45, -0.15, 0.15, 0.45)]
    return parts


def locomotive(rng: Generator) -> list[Solid]:
    """Make a locomotive: boiler, funnel and domes before a cab (steam), or a cab before a ribbed body (diesel)."""
    u = rng.uniform
    long, width, wheel, cab = u(4, 7), u(1.5, 2.0), u(0.35, 0.6), u(1.0, 1.8)
    deck = wheel * 1.6
    parts = [box(long, width * 0.85, 0.3).at(0, 0, deck), box(cab, width, u(1.5, 2.0)).at(-long / 2 + cab / 2, 0, deck + 0.2)]
    if rng.random() < 0.6:
        r, front = u(0.5, 0.75), long / 2
        parts += [
            rod((-long / 2 + cab, 0, deck + 0.3 + r), (front, 0, deck + 0.3 + r), r, u(0.85, 1), 16),
            cylinder(0.18, u(0.5, 0.9), u(1, 1.8)).at(front * 0.8, 0, deck + r * 2),
        ]
        parts += [ball(0.3).at(x * long, 0, deck + 0.3 + r * 1.9) for x in (-0.05, 0.15, 0.28)][: int(rng.integers(1, 4))]
        parts += [
            box(0.6, width * 0.9, deck, 0.5).at(front + 0.1, 0, 0),
            box(cab * 1.2, width * 1.1, 0.1).at(-long / 2 + cab / 2, 0, deck + 2.0),
        ]
    else:
        tall = u(1.0, 1.5)
        parts.append(box(long - cab, width * u(0.6, 0.95), tall).at(cab / 2, 0, deck + 0.2))
        parts += [box(0.3, width * 0.5, 0.2).at(x * long, 0, deck + 0.2 + tall) for x in (-0.1, 0.1, 0.3) if rng.random() < 0.7]
        parts += [rod((-long * 0.1, s * width * 0.48, deck + 0.8), (long * 0.5, s * width * 0.48, deck + 0.8), 0.04) for s in (-1, 1)]
    axles = np.linspace(-long * 0.4, long * 0.38, int(rng.integers(3, 6)))
    parts += [_wheel(wheel, 0.15).at(x, s * width * 0.4, wheel) for x in axles for s in (-1, 1)]
    side = rng.choice((-1, 1))
    return [*parts, rod((axles[0], side * width * 0.48, wheel * 1.2), (axles[-1], side * width * 0.48, wheel * 0.8), 0.06, sections=4)]


def _wheel(radius: float, width: float) -> Solid:
    return (
        lathe(
            [
                (radius * 0.5, 0.15 * width),
                (radius * 0.9, 0),
                (radius, width * 0.15),
                (radius, width * 0.85),
                (radius * 0.9, width),
                (radius * 0.5, width * 0.85),
            ],
            16,
        )
        .turned("x", 90)
        .at(y=width / 2)
    )
