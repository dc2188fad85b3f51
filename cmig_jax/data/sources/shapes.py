"""Generated objects (`data.generated`): no files are needed."""

from __future__ import annotations

import functools

import numpy as np
import trimesh

from cmig_jax.config import DataConfig
from cmig_jax.data.generated import CATEGORIES, make_object
from cmig_jax.data.raw import RawDataset, RawObject, Source, Split

_SEED = 20230626


def open_shapes(data: DataConfig) -> RawDataset:
    """Open generated objects: `data.shapes` per category to train on, a quarter as many, at least one, to test on."""
    splits: tuple[tuple[Split, int], ...] = (("train", data.shapes), ("test", max(1, data.shapes // 4)))
    objects = [
        RawObject(f"{split}/{name}-{i:04d}", label, split, functools.partial(_make_shape, split, label, i))
        for split, number in splits
        for label, name in enumerate(CATEGORIES)
        for i in range(number)
    ]
    return RawDataset(CATEGORIES, tuple(objects))


def _make_shape(split: Split, label: int, index: int) -> trimesh.Trimesh:
    return make_object(label, np.random.default_rng([_SEED, int(split == "test"), label, index]))


SOURCE = Source("shapes", open_shapes, folder=None, flags=("shapes",))
