"""What every method without learning shares: the form of a pose, the check of a cloud, and settings that can be written down."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Pose = tuple[Floats, Floats]


class Baseline(Protocol):
    """A method of registration, with every setting it runs with."""

    def register(self, source: ArrayLike, target: ArrayLike) -> Pose:
        """Return `target_from_source`: R `[3, 3]` and t `[3]`, float64, of a source `[N, 3]` and a target `[M, 3]`.

        Raises:
            ValueError: a cloud with fewer than 3 points, another shape, or coordinates that are not finite.
        """
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """The package with its version and every setting, as JSON has them."""
        ...


def no_motion() -> Pose:
    """Return the identity: where local methods start, and what a global method that finds nothing returns."""
    return np.eye(3), np.zeros(3)


def checked_cloud(points: ArrayLike, name: str) -> Floats:
    """Return a cloud as `[N, 3]` float64.

    Raises:
        ValueError: fewer than 3 points, another shape, or coordinates that are not finite; the message begins with `name`.
    """
    try:
        cloud = np.asarray(points, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected [points, 3] numbers ({error})") from error
    if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) < 3:
        raise ValueError(f"{name} of shape {cloud.shape}: expected [points, 3] with at least 3 points")
    for i in np.flatnonzero(~np.isfinite(cloud).all(1)):
        raise ValueError(f"{name}: point {i} is {cloud[i].tolist()}, expected finite coordinates")
    return np.ascontiguousarray(cloud)


def as_matrix(pose: Pose) -> Floats:
    """Return a pose as a `[4, 4]` matrix."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pose
    return T


def as_pose(T: ArrayLike) -> Pose | None:
    """Return the pose of a `[4, 4]` matrix, or None where it is none: not finite, or no rotation."""
    T = np.asarray(T, np.float64)
    R = T[:3, :3]
    if not np.isfinite(T).all() or not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        return None
    return R.copy(), T[:3, 3].copy()


def recorded(method: Any, package: str, **more: Any) -> dict[str, Any]:
    """Return the fields of a method, a frozen dataclass, as JSON has them, after `package` and what else is said."""
    fields = {field.name: getattr(method, field.name) for field in dataclasses.fields(method)}
    return {"package": package, **more} | {key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()}
