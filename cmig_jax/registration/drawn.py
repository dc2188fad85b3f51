"""Pairs of clouds of which it is known whether they belong together, and how: to calibrate the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from cmig_jax.data.protocol import keep_farthest_along
from cmig_jax.data.raw import RawObject
from cmig_jax.data.sample import normalise, sample_surface
from cmig_jax.transform import RigidTransform

Floats = NDArray[np.float64]
Kind = Literal["same", "other", "mirrored", "scaled"]
KINDS: dict[Kind, float] = {"same": 0.65, "other": 0.2, "mirrored": 0.05, "scaled": 0.1}
SPARSE, DENSE = (300, 1_024), (3_000, 8_000)
BOUND_DEG = 78.0
"""The largest rotation by up to 45 degrees about each axis."""
RADIUS = 100.0
"""Radius of the sphere of hidden point removal, in distances of the camera; larger ones see through more gaps."""


@dataclass(frozen=True)
class Drawn:
    """A pair.

    Attributes:
        source, target: `[N, 3]`, `[M, 3]`.
        pose: target_from_source, if they belong together.
        kind: `same` object; two objects; the same, `mirrored` or `scaled`.
        rotations: what `register` is told about the rotation.
    """

    source: Floats
    target: Floats
    pose: RigidTransform
    kind: Kind
    rotations: Literal["any"] | float


def draw(objects: list[RawObject], position: int, rng: np.random.Generator) -> Drawn:
    """Draw a pair that begins with the object at a position.

    Meshes give clouds of 300 to 8,000 points, whole, cut by a plane, or seen from one side; clouds give up to half their points, whole or
    cut. Noise has a standard deviation of up to 0.02 of the unit sphere. Rotations are any, or up to 45 degrees about each axis; then the
    bound is known in half of the cases.
    """
    kind: Kind = rng.choice(list(KINDS), p=list(KINDS.values()))
    other = (position + int(rng.integers(1, len(objects)))) % len(objects)
    dense = isinstance(objects[position].geometry(), trimesh.Trimesh) and rng.random() < 0.6
    count = int(np.exp(rng.uniform(*np.log(DENSE if dense else SPARSE))))
    keep = rng.choice([0.5, 0.75, 1.0], p=[0.3, 0.5, 0.2])
    noise = float(rng.choice([0, 0.002, 0.005, 0.01] if dense else [0, 0.005, 0.01, 0.02]))
    seen = dense and rng.random() < 0.6
    bounded = rng.random() < 0.5
    angles, quaternion = rng.uniform(-45, 45, 3), rng.normal(size=4)
    turn = Rotation.from_euler("xyz", angles, degrees=True) if bounded else Rotation.from_quat(quaternion)
    R, t = turn.as_matrix(), rng.uniform(-0.5, 0.5, 3)
    clouds = list(_two_samplings(objects[position], count, rng))
    if kind == "other":
        clouds[1] = _two_samplings(objects[other], count, rng)[1]
    if seen:
        towards = [_direction(rng) for _ in range(2)]
        towards[1] = _within(towards[0], 100.0, rng)
        clouds = [visible(cloud, 3.0 * direction) for cloud, direction in zip(clouds, towards, strict=True)]
    else:
        clouds = [keep_farthest_along(cloud, _direction(rng), keep) for cloud in clouds]
    source, target = (cloud + noise * rng.normal(size=cloud.shape) for cloud in clouds)
    if kind == "mirrored":
        source = source * [-1, 1, 1]
    if kind == "scaled":
        source = source * float(rng.choice([0.6, 0.8, 1.25, 2.0]))
    rotations = BOUND_DEG if bounded and rng.random() < 0.5 else "any"
    return Drawn(source, target @ R.T + t, RigidTransform(R, t), kind, rotations)


def visible(points: Floats, camera: Floats) -> Floats:
    """Return the points `[n, 3]` that a camera at `[3]` sees, by hidden point removal (Katz, Tal and Basri, SIGGRAPH 2007)."""
    seen = points - camera
    length = np.linalg.norm(seen, axis=1, keepdims=True)
    flipped = seen + 2 * (RADIUS * length.max() - length) * seen / length
    hull = ConvexHull(np.concatenate([flipped, np.zeros((1, 3))])).vertices
    return points[np.sort(hull[hull < len(points)])]


def _two_samplings(item: RawObject, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    geometry = item.geometry()
    if isinstance(geometry, trimesh.Trimesh):
        points = normalise(sample_surface(geometry, 2 * count, rng), item.name)
    else:
        points = normalise(geometry, item.name)[rng.permutation(len(geometry))]
        count = min(count, len(points) // 2)
    points = np.asarray(points, np.float64)
    return points[:count], points[-count:]


def _direction(rng: np.random.Generator) -> Floats:
    direction = rng.normal(size=3)
    return direction / np.linalg.norm(direction)


def _within(direction: Floats, limit_deg: float, rng: np.random.Generator) -> Floats:
    """Return a direction turned from another by up to an angle."""
    across = np.cross(direction, _direction(rng))
    return Rotation.from_rotvec(np.radians(rng.uniform(0, limit_deg)) * across / np.linalg.norm(across)).apply(direction)
