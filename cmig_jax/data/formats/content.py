"""What every format gives: the coordinates of a file, and its content, which can be moved and written again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

PRECISION = 1e-6
"""Largest error of stored coordinates, as a share of the cloud's extent."""


class Content(Protocol):
    """The content of a file, with the attributes that only its format knows."""

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode the content moved by a matrix `[4, 4]`, as a file of a suffix of the same family.

        Raises:
            ValueError: the format cannot hold the moved coordinates to `PRECISION`.
        """
        ...


def without_normals() -> np.ndarray | None:
    """Return None: the format has no normals of points, or they are not read."""
    return None


@dataclass(frozen=True)
class Parsed:
    """A file as it was read.

    Attributes:
        points: `[P, 3]` float64, every row of the file, also those that are not finite.
        faces: `[F, 3]` int64 indices into `points`; None for a cloud.
        content: all of the file.
        unit: name of the unit where the file says it.
        normals: function that reads the normals `[P, 3]` of the rows, in any length; it returns None for a file without them.
    """

    points: np.ndarray
    faces: np.ndarray | None
    content: Content
    unit: str | None = None
    normals: Callable[[], np.ndarray | None] = without_normals


@dataclass(frozen=True)
class Format:
    """How files of a suffix are read and written.

    Attributes:
        read: function of the decompressed bytes and the suffix. Suffixes that share it are one family.
        encode: function of points `[P, 3]`, faces `[F, 3]` or None, and the suffix, that encodes a file without other attributes.
    """

    read: Callable[[bytes, str], Parsed]
    encode: Callable[[np.ndarray, np.ndarray | None, str], bytes]


def moved_points(points: np.ndarray, target_from_source: np.ndarray) -> np.ndarray:
    """Move points `[P, 3]`; rows that are not finite stay so. Returns float64."""
    with np.errstate(invalid="ignore", over="ignore"):
        return turned(points, target_from_source) + target_from_source[:3, 3]


def turned(vectors: np.ndarray, target_from_source: np.ndarray) -> np.ndarray:
    """Turn directions `[P, 3]`, such as normals. Returns float64."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.einsum("ij,pj->pi", target_from_source[:3, :3], np.asarray(vectors, np.float64))


def extent(points: np.ndarray) -> float:
    """Return the largest side of the box around the finite rows of `[P, 3]`; 0 if there are none."""
    finite = points[np.isfinite(points).all(axis=1)]
    return float(np.ptp(finite, axis=0).max()) if len(finite) else 0.0


def coordinate_type(points: np.ndarray, stored: np.dtype | type = np.float32) -> np.dtype:
    """Choose the type of written coordinates: double precision if they were stored so, or if single precision moves a point too far."""
    stored = np.dtype(stored)
    if stored.kind == "f" and stored.itemsize >= 8:
        return np.dtype(np.float64)
    return np.dtype(np.float64 if single_precision_error(points) > PRECISION * extent(points) else np.float32)


def single_precision_error(points: np.ndarray) -> float:
    """Return the largest change of a finite coordinate by rounding to single precision."""
    finite = points[np.isfinite(points).all(axis=1)]
    with np.errstate(over="ignore"):
        return float(np.abs(finite.astype(np.float32) - finite).max(initial=0))


def check_single_precision(points: np.ndarray, suffix: str, better: str) -> None:
    """Raise ValueError if a format of single precision cannot hold the coordinates."""
    error = single_precision_error(points)
    if error > PRECISION * extent(points):
        message = f"{suffix[1:].upper()} has single precision, which moves these coordinates by up to {error:.3g}"
        raise ValueError(f"{message}; expected a file of {better}")


def axes(names: list[str]) -> tuple[str, str, str] | None:
    """Return the names of the columns x, y and z in any case, or None if one is missing."""
    return _three(names, (("x", "y", "z"),))


def normal_axes(names: list[str]) -> tuple[str, str, str] | None:
    """Return the names of the columns of normals, or None."""
    return _three(names, (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z")))


def moved_columns(columns: dict[str, np.ndarray], target_from_source: np.ndarray) -> dict[str, np.ndarray]:
    """Move the columns x y z of a table and turn its normals; other columns, and the order, stay."""
    result, names = dict(columns), list(columns)
    position, normal = axes(names), normal_axes(names)
    if position is not None:
        points = moved_points(stacked(columns, position), target_from_source)
        kind = coordinate_type(points, np.result_type(*(columns[name].dtype for name in position)))
        result.update((name, points[:, i].astype(kind)) for i, name in enumerate(position))
    if normal is not None:
        vectors = turned(stacked(columns, normal), target_from_source)
        result.update((name, vectors[:, i].astype(_float(columns[name].dtype))) for i, name in enumerate(normal))
    return result


def normals_of(columns: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """Return the columns of normals `[P, 3]` float64 of a table, or None."""
    names = normal_axes([name for name, column in columns.items() if column.ndim == 1])
    return None if names is None else stacked(columns, names)


def stacked(columns: Mapping[str, np.ndarray], names: tuple[str, str, str]) -> np.ndarray:
    """Return three columns as `[P, 3]` float64."""
    return np.stack([np.asarray(columns[name], np.float64) for name in names], axis=-1)


def are_normals(vectors: np.ndarray) -> bool:
    """Say whether all finite rows of `[P, 3]` have the length 1."""
    lengths = np.linalg.norm(vectors[np.isfinite(vectors).all(axis=1)], axis=1)
    return len(lengths) > 0 and bool((np.abs(lengths - 1) < 0.01).all())


def written_coordinates(points: np.ndarray) -> list[list[str]]:
    """Return points `[P, 3]` as text, with as many decimals as 1e-9 of the extent needs."""
    decimals = int(np.clip(np.ceil(9 - np.log10(extent(points) or 1.0)), 0, 17))
    return written(points, f"%.{decimals}f")


def written(rows: np.ndarray, number: str = "%.6g") -> list[list[str]]:
    """Return rows `[P, 3]` as text, each number in a %-format."""
    line = f"{number} {number} {number}"
    return [(line % (a, b, c)).split() for a, b, c in rows.tolist()]


def _float(kind: np.dtype) -> np.dtype:
    return kind if kind.kind == "f" else np.dtype(np.float32)


def _three(names: list[str], choices: tuple[tuple[str, str, str], ...]) -> tuple[str, str, str] | None:
    lowered = {name.lower(): name for name in reversed(names)}
    for a, b, c in choices:
        if a in lowered and b in lowered and c in lowered:
            return lowered[a], lowered[b], lowered[c]
    return None
