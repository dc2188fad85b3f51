"""The check that every point cloud passes, and the thinning of large ones."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Number = TypeVar("Number", bound=np.generic)


def check_cloud(points: ArrayLike, name: object = "points", fewest: int = 1) -> NDArray[np.float64]:
    """Return a cloud as `[N, 3]` float64. Single precision would resolve decimetres only in geographic coordinates.

    Args:
        points: `[N, 3]` real numbers.
        name: name of the cloud in an error, for example its file.
        fewest: smallest N.

    Raises:
        ValueError: masked points, another shape or kind of numbers, fewer points than `fewest`, or coordinates that are not finite.
    """
    if np.ma.is_masked(points):
        raise ValueError(f"{name}: {np.ma.count_masked(points)} masked values; expected none, masked points left out")
    try:
        given = np.asarray(points)
    except ValueError as error:
        raise ValueError(f"{name}: expected [N, 3] numbers ({error})") from error
    if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "fiu":
        raise ValueError(f"{name}: shape {given.shape}, {given.dtype}; expected [N, 3] real numbers{_remedy(given)}")
    if len(given) < fewest:
        raise ValueError(f"{name}: {len(given)} points; expected at least {fewest}")
    bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
    if len(bad):
        count = f"{len(bad)} of {len(given)} points"
        raise ValueError(f"{name}: point {bad[0]} is {given[bad[0]].tolist()}; expected finite coordinates ({count} have others)")
    return np.ascontiguousarray(given, np.float64)


def _remedy(given: np.ndarray) -> str:
    """Say what to pass instead, where that is clear."""
    if {"x", "y", "z"} <= set(given.dtype.names or ()):
        return ': pass np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=-1)'
    if given.ndim == 3 and given.shape[-1] == 3:
        return ": pass cloud.reshape(-1, 3)"
    if given.ndim == 2 and given.shape[1] > 3 and given.shape[0] != 3:
        return ": pass cloud[:, :3]"
    return ": pass cloud.T" if given.ndim == 2 and given.shape[0] == 3 else ""


def thinned(points: NDArray[Number], count: int, seed: int = 0) -> NDArray[Number]:
    """Return `count` random points of a larger cloud `[N, 3]`, the same ones every time, in their order."""
    if len(points) <= count:
        return points
    return points[np.sort(np.random.default_rng(seed).choice(len(points), count, replace=False))]
