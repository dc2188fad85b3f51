"""The interface of the methods without learning, the check of their clouds, and settings as JSON values."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmig_jax.clouds import check_cloud
from cmig_jax.transform import RigidTransform

Floats = NDArray[np.float64]
FEWEST_POINTS = 3


class Baseline(Protocol):
    """A method of registration with all its settings."""

    def register(self, source: ArrayLike, target: ArrayLike) -> RigidTransform:
        """Return `target_from_source`, NumPy float64, of a source `[N, 3]` and a target `[M, 3]`.

        Raises:
            ValueError: a cloud with fewer than 3 points, another shape, or coordinates that are not finite.
        """
        ...

    @property
    def settings(self) -> dict[str, Any]:
        """The package with its version and every setting, as JSON values."""
        ...


def no_motion() -> RigidTransform:
    """Return the identity as NumPy arrays, the start of local methods and the result of a global method that finds no pose."""
    return RigidTransform(R=np.eye(3), t=np.zeros(3))


def checked_clouds(source: ArrayLike, target: ArrayLike) -> tuple[Floats, Floats]:
    """Return both clouds as `[N, 3]` float64.

    Raises:
        ValueError: fewer than 3 points, another shape, or coordinates that are not finite; the message says which cloud.
    """
    return check_cloud(source, "source", FEWEST_POINTS), check_cloud(target, "target", FEWEST_POINTS)


def recorded(method: Any, package: str, **more: Any) -> dict[str, Any]:
    """Return the fields of a method, a frozen dataclass, as JSON values, after `package` and further settings."""
    fields = {field.name: getattr(method, field.name) for field in dataclasses.fields(method)}
    return {"package": package, **more} | {key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()}
