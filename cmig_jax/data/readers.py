"""Every source of raw objects behind one function (Sec. IV-A, IV-B, IV-D)."""

from __future__ import annotations

import functools

import numpy as np
import trimesh

from cmig_jax.config import DataConfig
from cmig_jax.data.geometry_files import open_meshes
from cmig_jax.data.modelnet_hdf5 import open_hdf5
from cmig_jax.data.raw import RawDataset, RawObject, Split
from cmig_jax.data.sevenscenes import open_sevenscenes
from cmig_jax.data.shapes import CATEGORIES, make_object
from cmig_jax.data.stanford import open_stanford

__all__ = ["RawDataset", "RawObject", "open_raw"]

_SHAPES_SEED = 20230626


def open_raw(data: DataConfig) -> RawDataset:
    """Open the raw objects that the flags name; names and labels are read now, geometry when it is asked for.

    Args:
        data: `source`, `root` and, for generated shapes, `shapes`.

    Returns:
        The categories and the objects of both splits. `stanford` and a `sevenscenes` root with one scene have no train objects.

    Raises:
        ValueError: a missing folder or file, or one that is not as the source expects; the message names it. Or a source of recorded
            pairs (`recordings.py`), which has no objects.
    """
    match data.source:
        case "shapes":
            return _open_shapes(data.shapes)
        case "modelnet40-hdf5":
            return open_hdf5(data.root)
        case "meshes":
            return open_meshes(data.root)
        case "stanford":
            return open_stanford(data.root)
        case "sevenscenes":
            return open_sevenscenes(data.root)
        case "stanford-scans" | "sevenscenes-fragments":
            raise ValueError(
                f"data.source = {data.source} has recorded pairs, no objects: it is for evaluation only "
                f"(python evaluate.py RUN_FOLDER --data.source {data.source})"
            )
        case _:
            raise ValueError(f"data.source = {data.source!r}: expected shapes, modelnet40-hdf5, meshes, stanford or sevenscenes")


def _open_shapes(count: int) -> RawDataset:
    """Generated objects: `count` a category to train on, a quarter as many, at least one, to test on."""
    if count < 1:
        raise ValueError(f"data.shapes = {count}: expected at least 1 object per category")
    splits: tuple[tuple[Split, int], ...] = (("train", count), ("test", max(1, count // 4)))
    objects = [
        RawObject(f"{split}/{name}-{i:04d}", label, split, functools.partial(_make_shape, split, label, i))
        for split, number in splits
        for label, name in enumerate(CATEGORIES)
        for i in range(number)
    ]
    return RawDataset(CATEGORIES, tuple(objects), "shapes")


def _make_shape(split: Split, label: int, index: int) -> trimesh.Trimesh:
    return make_object(label, np.random.default_rng([_SHAPES_SEED, int(split == "test"), label, index]))
