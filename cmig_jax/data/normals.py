"""Unit normals of point clouds: estimated from neighbours and oriented, or taken from a file."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from cmig_jax.clouds import check_cloud, thinned

NEIGHBOURS = 20
MOST_POINTS = 16384
"""Normals of a larger cloud are estimated from this many of its points: closer neighbours differ by the noise of the sensor alone."""


def estimate_normals(points: np.ndarray, k: int = NEIGHBOURS, *, at: np.ndarray | None = None) -> np.ndarray:
    """Estimate unit normals: the direction in which a point's `k` nearest neighbours vary least, pointing away from the cloud's mean.

    The rule for the side needs nothing but the cloud, so normals turn with it. It is right where the surface is seen from outside by a
    ray from the mean, as on a convex object. On the inner side of a cup or of a room, and where the surface is nearly parallel to that
    ray, neighbouring normals may point to opposite sides; and a crop moves the mean, so the two clouds of a pair may disagree there.

    Args:
        points: `[P, 3]`.
        k: number of neighbours, the point itself among them; all points of a smaller cloud.
        at: `[M, 3]` places of the normals; by default the points themselves.

    Returns:
        `[M, 3]` float64. Where neighbours lie on a line or coincide it is one of the directions that fit.

    Raises:
        ValueError: no points, coordinates that are not finite, or `k` below 3.
    """
    if k < 3:
        raise ValueError(f"k = {k}: expected at least 3 neighbours")
    cloud = check_cloud(points)
    places = cloud if at is None else check_cloud(at, "at")
    near = cloud[np.reshape(KDTree(cloud).query(places, min(k, len(cloud)))[1], (len(places), -1))]
    near -= near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("mki,mkj->mij", near, near))[1][:, :, 0]
    outwards = np.einsum("mi,mi->m", normals, places - cloud.mean(axis=0))
    return np.where(outwards[:, None] < 0, -normals, normals)


def observed_normals(points: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
    """Return `estimate_normals` as float32 `[M, 3]`, from at most `MOST_POINTS` random points of the cloud."""
    places = points if at is None else at
    return estimate_normals(thinned(points, MOST_POINTS), at=places).astype(np.float32)


def completed_normals(points: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Scale the normals `[P, 3]` of a file to length 1; estimate those that are zero or not finite.

    Args:
        points: `[P, 3]`.
        given: `[P, 3]` of the same points.

    Returns:
        `[P, 3]` float32.
    """
    length = np.linalg.norm(given, axis=1)
    known = np.isfinite(length) & (length > 0)
    normals = np.divide(given, length[:, None], where=known[:, None], out=np.zeros(given.shape))
    if not known.all():
        normals[~known] = observed_normals(points, at=points[~known])
    return normals.astype(np.float32)
