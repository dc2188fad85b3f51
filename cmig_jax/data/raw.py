"""Raw objects before preparation: what every reader returns, and the checks that all of them share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

Split = Literal["train", "test"]


@dataclass(frozen=True)
class RawObject:
    """One object, whose geometry is read when it is asked for.

    Attributes:
        name: unique enough to find the object again, such as its file.
        label: index into the categories of its dataset.
        split: "train" or "test".
        read: function without arguments that reads the geometry; it can be pickled.
        shuffled: the points come in random order, so that any run of them is a fair sample (ModelNet40 HDF5).
    """

    name: str
    label: int
    split: Split
    read: Callable[[], trimesh.Trimesh | np.ndarray]
    shuffled: bool = False

    def geometry(self) -> trimesh.Trimesh | np.ndarray:
        """Read the geometry: a mesh with a surface, or finite points `[P, 3]` float64, in the units of its source.

        Raises:
            ValueError: unreadable, no faces, no area, no points, or coordinates that are not finite; the message names the object.
        """
        value = self.read()
        return check_mesh(value, self.name) if isinstance(value, trimesh.Trimesh) else check_points(value, self.name)

    @property
    def mesh(self) -> trimesh.Trimesh | None:
        """The geometry where it is a mesh, else None; read at every access."""
        value = self.geometry()
        return value if isinstance(value, trimesh.Trimesh) else None

    @property
    def points(self) -> np.ndarray | None:
        """The geometry where it is a cloud `[P, 3]` float64, else None; read at every access."""
        value = self.geometry()
        return None if isinstance(value, trimesh.Trimesh) else value


@dataclass(frozen=True)
class RawDataset:
    """The objects of a source.

    Attributes:
        categories: names by label.
        objects: train objects first; opening a dataset reads names and labels only.
        source: kind of data, as in `config.DataConfig.source`.
    """

    categories: tuple[str, ...]
    objects: Sequence[RawObject]
    source: str


@dataclass(frozen=True)
class Recording:
    """What a sensor saw from one place, in the frame of that place.

    Attributes:
        name: unique in its dataset.
        label: index into the categories of its dataset.
        read: function without arguments that reads the cloud `[P, 3]`, in the units of the source.
        world_from_sensor: `[4, 4]` float64, rigid, in the same units.
    """

    name: str
    label: int
    read: Callable[[], np.ndarray]
    world_from_sensor: np.ndarray


@dataclass(frozen=True)
class RecordedDataset:
    """The recordings of a source, to evaluate on.

    Attributes:
        categories: names by label: the scenes.
        recordings: opening a dataset reads names and poses only.
        candidates: positions (i, j), i < j, of recordings that may overlap.
        source: kind of data, as in `config.DataConfig.source`.
    """

    categories: tuple[str, ...]
    recordings: Sequence[Recording]
    candidates: Sequence[tuple[int, int]]
    source: str


def existing_folder(root: str | Path | None, expected: str) -> Path:
    """Return the folder of the raw data.

    Raises:
        ValueError: none was named, or it is missing.
    """
    if root is None:
        raise ValueError(f"data.root = None: expected {expected}")
    if not Path(root).is_dir():
        raise ValueError(f"{root}: no such folder; expected {expected}")
    return Path(root)


def check_mesh(mesh: trimesh.Trimesh, name: object) -> trimesh.Trimesh:
    """Return a mesh that has a surface of finite corners.

    Raises:
        ValueError: no faces, a face of a missing vertex, coordinates that are not finite, or no area.
    """
    count = len(mesh.vertices)
    if len(mesh.faces) == 0:
        raise ValueError(f"{name}: 0 faces; expected a mesh with at least one")
    if mesh.faces.min() < 0 or mesh.faces.max() >= count:
        raise ValueError(f"{name}: a face of vertex {mesh.faces.max()}; expected 0 to {count - 1}")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError(f"{name}: {_not_finite(mesh.vertices)}; expected finite coordinates")
    if not mesh.area > 0:
        raise ValueError(f"{name}: surface area {mesh.area}; expected more than 0")
    return mesh


def check_points(points: np.ndarray, name: object) -> np.ndarray:
    """Return finite points `[P, 3]`, P >= 1, as float64: in geographic coordinates single precision has decimetres.

    Raises:
        ValueError: another shape or kind of numbers, or coordinates that are not finite.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or points.dtype.kind not in "fiu":
        raise ValueError(f"{name}: points of shape {points.shape}, {points.dtype}; expected [P, 3] numbers with P >= 1")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: {_not_finite(points)}; expected finite coordinates")
    return points.astype(np.float64)


def _not_finite(points: np.ndarray) -> str:
    row = int(np.flatnonzero(~np.isfinite(points).all(1))[0])
    return f"point {row} is {points[row].tolist()}"
