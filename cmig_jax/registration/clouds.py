"""A user's two clouds: checked, without duplicates, and normalised so that stray points move neither centre nor scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cmig_jax.clouds import check_cloud

Floats = NDArray[np.float64]
FEWEST = 10
"""Fewest different points: a covariance needs neighbours that lie on a surface."""
FAR = 1_000
"""Points farther away than so many median distances from the median point are left out: no return, or a failed match of a sensor."""
SORTED_UP_TO = 200_000
"""Larger clouds are thinned first, which merges duplicates and does not depend on the order of rows."""
STEPS = 200
"""A cloud must be so many steps of its number format wide."""


@dataclass(frozen=True)
class UserCloud:
    """A cloud that was checked.

    Attributes:
        points: `[N, 3]` float64, different rows and none `FAR` away, in an order that does not depend on the order of the rows given.
        rows: `[N]`, where they stand in what was given.
        dropped: rows left out because they are not finite.
        centre: `[3]`, mean of the points without stray ones.
        radius: 1.1 times the distance from the centre that 95 % of the points are within.
    """

    points: Floats
    rows: NDArray[np.int64]
    dropped: int
    centre: Floats
    radius: float


def user_cloud(given: Any, name: str, invalid: Literal["error", "drop"] = "error") -> UserCloud:
    """Check a cloud.

    Args:
        given: `[N, 3]` real numbers (NumPy, JAX, PyTorch, lists), or an object with `points` or `vertices` (Open3D, trimesh, PyVista).
        name: name of the cloud in an error.
        invalid: what to do with rows that are not finite.

    Raises:
        ValueError: another shape or kind of numbers, rows that are not finite (unless dropped), fewer than `FEWEST` different points,
            points on a line, or coordinates whose number format does not resolve the shape.
    """
    try:
        given = _as_array(given)
    except (ValueError, TypeError) as error:  # rows of unequal lengths
        raise ValueError(f"{name}: expected [N, 3] numbers ({error})") from error
    rows = np.arange(len(given)) if given.ndim else np.arange(0)
    if invalid == "drop" and given.ndim == 2 and given.dtype.kind == "f":
        rows = np.flatnonzero(np.isfinite(given).all(axis=1))
    dropped = (len(given) if given.ndim else 0) - len(rows)
    points = check_cloud(given[rows] if dropped else given, name, 0)
    kept = _different(points)
    kept = kept[_near(points[kept])] if len(kept) >= FEWEST else kept
    points, rows = points[kept], rows[kept]
    if len(points) < FEWEST:
        known = "if it is known which points belong together, three pairs fix a pose: scipy's Rotation.align_vectors"
        raise ValueError(f"{name}: {len(points)} different points; expected at least {FEWEST} ({known})")
    _check_shape(points, given.dtype, name)
    centre, radius = _robust(points)
    return UserCloud(points, rows, dropped, centre, radius)


def _as_array(given: Any) -> np.ndarray:
    """Return the coordinates of an array, a PyTorch tensor, or an object that has points or vertices."""
    if np.ma.is_masked(given):
        return given
    if hasattr(given, "detach"):  # PyTorch: one that requires a gradient, or is of a type that NumPy does not have, does not convert
        return given.detach().cpu().double().numpy()
    if not isinstance(given, (np.ndarray, list, tuple)) and not hasattr(given, "__array__"):
        for attribute in ("points", "vertices"):
            if hasattr(given, attribute):
                return np.asarray(getattr(given, attribute))
    return given if isinstance(given, np.ndarray) else np.asarray(given)


def _different(points: Floats) -> NDArray[np.int64]:
    """Return positions without those of repeated points; of large clouds, only the origin (no return of a sensor) is not repeated."""
    if len(points) <= SORTED_UP_TO:
        return np.unique(points, axis=0, return_index=True)[1]
    at_origin = ~points.any(axis=1)
    return np.flatnonzero(~at_origin | (np.cumsum(at_origin) == 1))


def _near(points: Floats) -> NDArray[np.bool_]:
    with np.errstate(over="ignore"):
        distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return distance <= FAR * (np.median(distance) or np.inf)


def _check_shape(points: Floats, dtype: np.dtype, name: str) -> None:
    size = np.abs(points).max()
    step = float(np.finfo(dtype).eps) * size if dtype.kind == "f" else 0.0
    extent = float(np.ptp(points, axis=0).max())
    if dtype.itemsize < 8 and extent < STEPS * step:
        raise ValueError(
            f"{name}: {dtype} resolves {step:.2g} at coordinates around {size:.3g}, and the cloud is {extent:.3g} wide; "
            "expected float64, or coordinates from which an offset was subtracted before they became single precision"
        )
    some = points[:: 1 + len(points) // SORTED_UP_TO]
    spread = np.linalg.svd(some - some.mean(axis=0), compute_uv=False)
    if spread[1] <= max(1e-9, 16 * step / max(spread[0], size)) * max(spread[0], size):
        raise ValueError(f"{name}: all points are equal or on one line, which leaves the rotation open; expected a surface")


def _robust(points: Floats) -> tuple[Floats, float]:
    """Return the mean of the points that are not stray, and the radius around it."""
    middle = np.median(points, axis=0)
    distance = np.linalg.norm(points - middle, axis=1)
    centre = points[distance <= 4 * np.median(distance)].mean(axis=0)
    return centre, 1.1 * float(np.quantile(np.linalg.norm(points - centre, axis=1), 0.95))
