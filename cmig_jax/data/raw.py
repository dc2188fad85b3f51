"""Raw data before preparation: the declaration of a source, its objects or recordings, and the checks that all sources share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from cmig_jax.clouds import check_cloud
from cmig_jax.config import DataConfig
from cmig_jax.data.normals import completed_normals

Split = Literal["train", "test"]


@dataclass(frozen=True)
class CloudWithNormals:
    """A cloud whose file has normals: `points [P, 3]` and `normals [P, 3]`, of any length."""

    points: np.ndarray
    normals: np.ndarray


@dataclass(frozen=True)
class RawObject:
    """One object; its geometry is read by `geometry`.

    Attributes:
        name: unique in its split, for example its file; the seeds of the object's points and pairs depend on it.
        label: index into the categories of its dataset.
        split: "train" or "test".
        read: function without arguments that reads the geometry; it can be pickled.
        shuffled: whether a cloud is stored in random order, so that its first points are a fair sample (ModelNet40 HDF5); others are
            permuted.
    """

    name: str
    label: int
    split: Split
    read: Callable[[], trimesh.Trimesh | np.ndarray | CloudWithNormals]
    shuffled: bool = False

    def geometry(self) -> trimesh.Trimesh | np.ndarray:
        """Read the geometry: a mesh with a surface, or finite points `[P, 3]` float64, in the units of its source.

        Raises:
            ValueError: unreadable, no faces, no area, no points, or coordinates that are not finite; the message names the object.
        """
        return self.geometry_and_normals()[0]

    def geometry_and_normals(self) -> tuple[trimesh.Trimesh | np.ndarray, np.ndarray | None]:
        """Read the geometry, and the unit normals `[P, 3]` of a cloud whose file has them; None for others.

        Raises:
            ValueError: as `geometry`, or normals of another shape than the points.
        """
        value = self.read()
        if isinstance(value, trimesh.Trimesh):
            return check_mesh(value, self.name), None
        if not isinstance(value, CloudWithNormals):
            return check_cloud(value, self.name), None
        points = check_cloud(value.points, self.name)
        if np.shape(value.normals) != points.shape:
            raise ValueError(f"{self.name}: normals of shape {np.shape(value.normals)}; expected {points.shape}, as the points")
        return points, completed_normals(points, np.asarray(value.normals, np.float64))


@dataclass(frozen=True)
class RawDataset:
    """The objects of a source.

    Attributes:
        categories: names by label.
        objects: train objects first; opening a dataset reads names and labels only.
    """

    categories: tuple[str, ...]
    objects: Sequence[RawObject]


@dataclass(frozen=True)
class Recording:
    """A cloud that a sensor saw from one place, in the sensor's frame.

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
    """The recordings of a source.

    Attributes:
        categories: names by label: the scenes.
        recordings: opening a dataset reads names and poses only.
        candidates: positions (i, j), i < j, of recordings that may overlap.
    """

    categories: tuple[str, ...]
    recordings: Sequence[Recording]
    candidates: Sequence[tuple[int, int]]


@dataclass(frozen=True)
class Source:
    """The declaration of a kind of data: all that the rest of the package knows of it.

    Attributes:
        name: value of `data.source`.
        open: function that opens the data of these flags; it reads names and labels only.
        records: whether it opens recordings with true poses, for evaluation only, instead of objects that the protocol makes pairs of.
        trains: whether it has objects to train on.
        folder: name of the download whose folder is `data.root`; several sources may share it. None if it needs no files.
        flags: names of further flags of `DataConfig` that its objects depend on.
    """

    name: str
    open: Callable[[DataConfig], RawDataset | RecordedDataset]
    records: bool = False
    trains: bool = True
    folder: str | None = "data"
    flags: tuple[str, ...] = ()


def existing_folder(root: str | Path | None, expected: str) -> Path:
    """Return the folder of the raw data.

    Raises:
        ValueError: `root` is None, or not a folder.
    """
    if root is None:
        raise ValueError(f"data.root = None: expected {expected}")
    if not Path(root).is_dir():
        raise ValueError(f"{root}: no such folder; expected {expected}")
    return Path(root)


def visible_files(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a pattern by name, without hidden ones (macOS puts a `._name` beside a file)."""
    return [path for path in sorted(folder.glob(pattern)) if path.is_file() and not path.name.startswith(".")]


def check_mesh(mesh: trimesh.Trimesh, name: object) -> trimesh.Trimesh:
    """Return the mesh if it has a surface and finite coordinates.

    Raises:
        ValueError: no faces, a face with a vertex that does not exist, coordinates that are not finite, or no area.
    """
    count = len(mesh.vertices)
    if len(mesh.faces) == 0:
        raise ValueError(f"{name}: 0 faces; expected a mesh with at least one")
    if mesh.faces.min() < 0 or mesh.faces.max() >= count:
        raise ValueError(f"{name}: a face of vertex {mesh.faces.max()}; expected 0 to {count - 1}")
    check_cloud(mesh.vertices, name)
    if not mesh.area > 0:
        raise ValueError(f"{name}: surface area {mesh.area}; expected more than 0")
    return mesh
