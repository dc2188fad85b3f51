"""Closed solids: the parts of the generated objects.

Every solid is a loft: a stack of rings with the same number of corners, joined by triangles and closed by two fans. Lengths are in
object units, z is up, x is forward. Solids may overlap; the surface of each is closed and faces outwards.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

Axis = Literal["x", "y", "z"]
_AXES = {"x": 0, "y": 1, "z": 2}


@dataclass(frozen=True)
class Solid:
    """A closed surface: `vertices` `[V, 3]` float64 and `faces` `[F, 3]` int64, counter-clockwise seen from outside."""

    vertices: np.ndarray
    faces: np.ndarray

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
        """Return the solid moved by (x, y, z)."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)

    def turned(self, axis: Axis, degrees: float) -> Solid:
        """Return the solid rotated about a coordinate axis through the origin."""
        i = _AXES[axis]
        j, k = (i + 1) % 3, (i + 2) % 3
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        vertices = self.vertices.copy()
        vertices[:, j] = c * self.vertices[:, j] - s * self.vertices[:, k]
        vertices[:, k] = s * self.vertices[:, j] + c * self.vertices[:, k]
        return Solid(vertices, self.faces)


def box(length: float, width: float, height: float, top: float = 1.0) -> Solid:
    """Make a box of extents (x, y, z) that stands on z = 0, centred in x and y; `top` scales its upper face."""
    base = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (length / 2, width / 2)
    return loft(np.stack([_flat(base, 0.0), _flat(base * top, height)]))


def plate(outline: ArrayLike, height: float) -> Solid:
    """Extrude an outline `[S, 2]` in xy, star-shaped about the mean of its corners, from z = 0 to `height`."""
    points = np.asarray(outline, float)
    return loft(np.stack([_flat(points, 0.0), _flat(points, height)]))


def panel(corners: Sequence[tuple[float, float]], thickness: float) -> Solid:
    """Extrude corners (x, z) of an upright sheet, star-shaped about their mean, to a thickness along y centred at y = 0."""
    x, z = np.asarray(corners, float).T
    return loft(np.stack([np.stack([x, 0 * x + s * thickness / 2, z], -1) for s in (-1, 1)]))


def cylinder(radius: float, height: float, top: float = 1.0, sections: int = 20) -> Solid:
    """Make a cylinder that stands on z = 0; `top` scales its upper face."""
    return lathe([(radius, 0.0), (radius * top, height)], sections)


def ball(x: float, y: float | None = None, z: float | None = None, sections: int = 16) -> Solid:
    """Make an ellipsoid of half axes (x, y, z) about the origin; y and z default to x."""
    angles = np.radians(np.linspace(-90, 90, 9))
    unit = lathe(list(zip(np.cos(angles).round(12), np.sin(angles), strict=True)), sections)
    return Solid(unit.vertices * (x, x if y is None else y, x if z is None else z), unit.faces)


def lathe(profile: Sequence[tuple[float, float]], sections: int = 24) -> Solid:
    """Turn a profile of (radius, z) about the z axis; an end of radius 0 is a pole, any other end is closed by a disc."""
    r, z = np.asarray(profile, float).T
    inner = slice(1 if r[0] == 0 else 0, -1 if r[-1] == 0 else None)
    angles = np.arange(sections) * (2 * np.pi / sections)
    circle = np.stack([np.cos(angles), np.sin(angles)], -1)
    rings = np.stack([_flat(circle * radius, height) for radius, height in zip(r[inner], z[inner], strict=True)])
    return loft(rings, start=np.array([0, 0, z[0]]), end=np.array([0, 0, z[-1]]))


def vessel(profile: Sequence[tuple[float, float]], wall: float, sections: int = 24) -> Solid:
    """Turn an open vessel: the outer profile of (radius > wall, z) from the foot to the rim, and an inner wall behind it."""
    floor = profile[0][1] + wall
    inner = [(r - wall, z) for r, z in profile[::-1] if z > floor]
    return lathe([*profile, *inner, (inner[-1][0], floor)], sections)


def tube(path: ArrayLike, radius: ArrayLike, sections: int = 8, closed: bool = False) -> Solid:
    """Sweep a circle along a path `[L, 3]`; `radius` is one number or one for each point; a closed path ends where it starts."""
    points = np.asarray(path, float)
    steps = np.roll(points, -1, 0) - points
    before = np.roll(steps, 1, 0)
    if not closed:
        steps[-1], before[0] = steps[-2], steps[0]
    tangents = _unit(_unit(steps) + _unit(before))
    normal = _unit(np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))]))
    angles = np.arange(sections) * (2 * np.pi / sections) + np.pi / sections
    rings = []
    for point, tangent, r in zip(points, tangents, np.broadcast_to(np.asarray(radius, float), len(points)), strict=True):
        normal = _unit(normal - tangent * (normal @ tangent))
        side = np.cross(tangent, normal)
        rings.append(point + r * (np.cos(angles)[:, None] * normal + np.sin(angles)[:, None] * side))
    return loft(np.stack(rings), closed=closed)


def rod(start: ArrayLike, end: ArrayLike, radius: float, taper: float = 1.0, sections: int = 8) -> Solid:
    """Make a straight bar between two points; `taper` scales the radius at its end; 4 sections make it square."""
    return tube(np.stack([np.asarray(start, float), np.asarray(end, float)]), [radius, radius * taper], sections)


def ring(radius: float, thickness: float, axis: Axis = "z", sections: int = 8) -> Solid:
    """Make a torus about a coordinate axis: `radius` to the middle of a bar of radius `thickness`."""
    angles = np.radians(np.arange(0, 360, 15))
    circle = np.zeros((len(angles), 3))
    circle[:, (_AXES[axis] + 1) % 3], circle[:, (_AXES[axis] + 2) % 3] = radius * np.cos(angles), radius * np.sin(angles)
    return tube(circle, thickness, sections, closed=True)


def hull(stations: Sequence[tuple[float, float, float, float]], square: float = 0.5, sections: int = 16) -> Solid:
    """Join cross-sections along x, each given as (x, width, z of its bottom, z of its top).

    Args:
        stations: cross-sections, x increasing.
        square: 0 makes them ellipses, 1 nearly rectangles.
        sections: corners of a cross-section.
    """
    angles = (np.arange(sections) + 0.5) * (2 * np.pi / sections)
    power = 1.0 - 0.85 * square
    c, s = (np.sign(f) * np.abs(f) ** power for f in (np.cos(angles), np.sin(angles)))
    x, width, low, high = np.asarray(stations, float)[:, :, None].transpose(1, 0, 2)
    return loft(np.stack([x + 0 * c, width / 2 * c, (low + high) / 2 + (high - low) / 2 * s], -1))


def curve(controls: Sequence[ArrayLike], count: int = 10) -> np.ndarray:
    """Return `[count, 3]` points of the Bezier curve of some control points."""
    points = np.broadcast_to(np.asarray(controls, float)[:, None], (len(controls), count, 3))
    t = np.linspace(0, 1, count)[:, None]
    while len(points) > 1:
        points = (1 - t) * points[:-1] + t * points[1:]
    return points[0]


def loft(rings: np.ndarray, start: np.ndarray | None = None, end: np.ndarray | None = None, closed: bool = False) -> Solid:
    """Join rings of corners into a closed solid.

    Args:
        rings: `[L, S, 3]`.
        start: tip of the fan that closes the first ring (default: the mean of its corners).
        end: the same for the last ring.
        closed: join the last ring to the first instead.

    Returns:
        The solid, facing outwards whichever way the rings turn.
    """
    count, sections = rings.shape[:2]
    tips = [rings[0].mean(0) if start is None else start, rings[-1].mean(0) if end is None else end]
    vertices = rings.reshape(-1, 3) if closed else np.concatenate([rings.reshape(-1, 3), tips])
    faces = _loft_faces(count, sections, closed)
    a, b, c = (vertices[faces[:, i]] - vertices[0] for i in range(3))
    outwards = np.sum(a * np.cross(b, c)) > 0
    return Solid(vertices, faces if outwards else faces[:, ::-1])


@functools.cache
def _loft_faces(count: int, sections: int, closed: bool) -> np.ndarray:
    here = np.arange(sections)
    there = np.roll(here, -1)
    faces = []
    for level in range(count if closed else count - 1):
        low, high = level * sections, (level + 1) % count * sections
        faces += [np.stack([low + here, low + there, high + there], -1), np.stack([low + here, high + there, high + here], -1)]
    if not closed:
        first, last = count * sections, (count - 1) * sections
        faces += [np.stack([there, here, np.full(sections, first)], -1)]
        faces += [np.stack([last + here, last + there, np.full(sections, first + 1)], -1)]
    return np.concatenate(faces)


def _flat(outline: np.ndarray, z: float) -> np.ndarray:
    return np.concatenate([outline, np.full((len(outline), 1), z)], -1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
