"""Points of an object: uniform sampling of a surface, and normalisation to the unit sphere (Sec. IV-B)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from cmig_jax.clouds import check_cloud
from cmig_jax.data.raw import check_mesh

RESOLUTION = float(np.finfo(np.float64).eps / np.finfo(np.float32).eps)
"""Smallest radius of a cloud, relative to its coordinates, at which float64 coordinates still give normalised float32 ones."""


def sample_surface(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw points from a surface, uniform by area.

    Args:
        mesh: triangles.
        count: number of points P, at least 1.
        rng: random generator; the points are a function of the mesh and of this generator's state.

    Returns:
        `[P, 3]` float32 in the units of the mesh, in random order.

    Raises:
        ValueError: as `sample_surface_and_normals`.
    """
    return sample_surface_and_normals(mesh, count, rng)[0]


def sample_surface_and_normals(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw the points of `sample_surface`, and return the unit normals of their faces too.

    A normal points to the side from which the corners of its face are in counter-clockwise order: outwards on a well-made mesh.

    Returns:
        Points and normals, `[P, 3]` float32 each.

    Raises:
        ValueError: no faces, no area, coordinates that are not finite, or `count` below 1.
    """
    if count < 1:
        raise ValueError(f"count = {count}: expected at least 1 point")
    check_mesh(mesh, "mesh")
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    edges = corners[:, 1:] - corners[:, :1]
    across = np.cross(edges[:, 0], edges[:, 1])
    areas = np.linalg.norm(across, axis=-1)
    area = np.cumsum(areas)
    face = np.searchsorted(area, rng.random(count) * area[-1], side="right").clip(max=len(area) - 1)
    # Reflecting the outer half of the parallelogram keeps the density uniform on the triangle.
    weight = rng.random((count, 2))
    weight = np.where(weight.sum(1, keepdims=True) > 1, 1 - weight, weight)
    points = corners[face, 0] + np.einsum("pe,pec->pc", weight, edges[face])
    return points.astype(np.float32), (across[face] / areas[face, None]).astype(np.float32)  # a face without area is never drawn


def centre(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Move points `[P, 3]` so that their mean is the origin.

    Returns:
        The moved points `[P, 3]`, their mean `[3]`, and their largest norm; 0 if the points are equal up to rounding.
    """
    mean = points.mean(0)
    centred = points - mean
    radius = float(np.linalg.norm(centred, axis=-1).max())
    return centred, mean, radius if radius > RESOLUTION * np.abs(points).max() else 0.0


def normalise(points: np.ndarray, name: object = "points") -> np.ndarray:
    """Centre points at their mean and scale them so that the farthest lies on the unit sphere, as ModelNet40 HDF5 does.

    Args:
        points: `[P, 3]`, any unit.
        name: name of the points in an error.

    Returns:
        `[P, 3]` float32 of largest norm 1.

    Raises:
        ValueError: a wrong shape, coordinates that are not finite, or all points equal.
    """
    exact = check_cloud(points, name)
    centred, _, scale = centre(exact)
    if scale == 0:
        raise ValueError(f"{name}: all {len(exact)} points equal {exact[0].tolist()}; expected points apart")
    return (centred / scale).astype(np.float32)


@dataclass(frozen=True)
class NormalisedPair:
    """Two clouds, each centred at its own mean, both scaled by one factor so that the farthest point lies on the unit sphere.

    Centres and scale come from the clouds alone, so they reveal nothing about the transform between them.

    Attributes:
        source, target: `[N, 3]`, `[M, 3]` float64, normalised.
        source_centre, target_centre: `[3]`, in the original unit.
        scale: original cloud = normalised cloud * scale + centre.
    """

    source: NDArray[np.float64]
    target: NDArray[np.float64]
    source_centre: NDArray[np.float64]
    target_centre: NDArray[np.float64]
    scale: float

    def normalised_translation(self, R: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Return the translation between the normalised clouds, given R and t of target_from_source between the original ones."""
        return (R @ self.source_centre + t - self.target_centre) / self.scale

    def original_translation(self, R: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Undo `normalised_translation`."""
        return self.target_centre + self.scale * t - R @ self.source_centre


def normalise_pair(source: np.ndarray, target: np.ndarray) -> NormalisedPair:
    """Normalise two clouds of one unit together.

    Args:
        source: `[N, 3]`.
        target: `[M, 3]`.

    Raises:
        ValueError: a wrong shape, coordinates that are not finite, or all points of both clouds equal to their centres.
    """
    x, y = check_cloud(source, "source"), check_cloud(target, "target")
    (x, source_centre, source_radius), (y, target_centre, target_radius) = centre(x), centre(y)
    scale = max(source_radius, target_radius)
    if scale == 0:
        raise ValueError(
            f"source and target: all points equal {source_centre.tolist()} and {target_centre.tolist()}; expected points apart"
        )
    return NormalisedPair(x / scale, y / scale, source_centre, target_centre, scale)
