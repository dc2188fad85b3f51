"""Pairs of objects, as the networks and the evaluation read them.

A pair is a dict of arrays: `source [N, 3]`, `target [M, 3]`, `R [3, 3]`, `t [3]` with `target = R source + t`, `views [S, V, H, W]`
uint8, `object [P, 3]` the complete clean object in the source's frame, `label` and `index`; for a network that reads them also
`source_normals [N, 3]` and `target_normals [M, 3]`.
"""

from __future__ import annotations

import zlib
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from cmig_jax.config import Categories, DataConfig, ViewsConfig
from cmig_jax.data.normals import observed_normals
from cmig_jax.data.protocol import make_clouds, random_rotation
from cmig_jax.data.render import render_views
from cmig_jax.data.shards import Shards

Pair = dict[str, Any]


class Pairs(Sequence[Pair]):
    """A list of pairs, one per object: each is a function of (seed, name of the object) alone, not of the other objects.

    Args:
        objects: all objects of the split.
        indices: `[n]` numbers of the objects to make pairs of.
        data: flags of the protocol.
        views: flags of the views to attach; None attaches none.
        seed: seed of poses, crops and noise.
        normals: whether to attach normals, as `data.normals` says; they change nothing else of a pair.

    Raises:
        ValueError: objects that were prepared without normals; the message has the command that adds them.
    """

    def __init__(
        self, objects: Shards, indices: np.ndarray, data: DataConfig, views: ViewsConfig | None, seed: int, *, normals: bool = False
    ) -> None:
        if normals and data.normals == "object":
            objects.check_normals()
        self.objects, self.indices, self.data, self.views, self.seed, self.normals = objects, indices, data, views, seed, normals

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: int) -> Pair:  # type: ignore[override]
        if not -len(self) <= position < len(self):
            raise IndexError(position)
        position %= len(self)
        return self.draw(position, seeded(self.seed, self.objects.names[int(self.indices[position])]))

    @property
    def categories(self) -> Sequence[str]:
        """Names of the categories that `label` counts."""
        return self.objects.categories

    @property
    def names(self) -> Sequence[str]:
        """Name of each pair's object."""
        return [self.objects.names[int(i)] for i in self.indices]

    def draw(self, position: int, rng: np.random.Generator) -> Pair:
        """Make a pair of the object at `position` with the caller's random numbers; `views.shown` changes nothing but its views."""
        pair = make_pair(self.objects, int(self.indices[position]), self.data, rng, normals=self.normals)
        if self.views is not None:
            pair["views"] = self._shown(pair, self.views, rng)
        return pair

    def _shown(self, pair: Pair, views: ViewsConfig, rng: np.random.Generator) -> np.ndarray:
        """Return the views that `views.shown` asks for; `rng` has made the pair already, so that further draws cannot change it."""
        if views.shown == "zero":
            return black(views)
        if views.shown == "shuffled":
            others = np.flatnonzero(np.arange(len(self.objects.labels)) != pair["index"])
            if len(others) == 0:
                raise ValueError(f"views.shown=shuffled with object {pair['index']} alone: expected at least one other object")
            pair = make_pair(self.objects, int(rng.choice(others)), self.data, rng)
        return observe(self.objects, pair, views)


def seeded(seed: int, name: str) -> np.random.Generator:
    """Return the random generator of the object or pair with this name."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def make_pair(objects: Shards, index: int, data: DataConfig, rng: np.random.Generator, *, normals: bool = False) -> Pair:
    """Draw a pair of one object, without views; `normals` adds normals and changes nothing else.

    Raises:
        ValueError: the object has too few points for `data.points` and `data.sampling`, or was prepared without normals.
    """
    points = objects.points(index)
    rows = np.concatenate([points, objects.normals(index)], axis=1) if normals and data.normals == "object" else points
    # Not the generator of the validation pair, which would draw the same numbers for something else.
    poses = seeded(data.test_seed, f"pose: {objects.names[index]}") if data.pose_of == "each-object" else rng
    clouds = make_clouds(rows, data, f"object {objects.names[index]}", rng, poses)
    if normals and data.normals == "observed":
        clouds |= {f"{cloud}_normals": observed_normals(clouds[cloud]) for cloud in ("source", "target")}
    pair = {**clouds, "object": np.asarray(points, np.float32), "label": np.int32(objects.labels[index]), "index": np.int32(index)}
    return turned(pair, random_rotation(rng)) if data.frame == "any" or (data.frame == "half" and rng.random() < 0.5) else pair


def turned(pair: Pair, rotation: np.ndarray) -> Pair:
    """Turn a pair without views as a whole, by `[3, 3]`: another frame for the same clouds."""
    parts = ("source", "target", "object", "source_normals", "target_normals")
    moved = {key: pair[key] @ rotation.T for key in parts if key in pair}
    moved |= {"R": rotation @ pair["R"] @ rotation.T, "t": rotation @ pair["t"]}
    return pair | {key: np.ascontiguousarray(value, np.float32) for key, value in moved.items()}


def observe(objects: Shards, pair: Pair, views: ViewsConfig) -> np.ndarray:
    """Return the depth views of a pair, `[S, V, H, W]` uint8: those of the object, or views of the observed clouds.

    Raises:
        ValueError: `views.of=object`, but none were rendered ahead of time.
    """
    if views.of == "object":
        ready = objects.views(int(pair["index"]))
        if ready is None:
            raise ValueError("views.of=object needs views rendered ahead of time: prepare the data with the same views flags")
        return np.asarray(ready)[None]
    return render_clouds(pair, views)


def render_clouds(pair: Pair, views: ViewsConfig) -> np.ndarray:
    """Render the observed clouds, `[S, V, H, W]` uint8: the source, the target, or each, as `views.of` says.

    Raises:
        ValueError: `views.of=object`, which two partial clouds do not show.
    """
    if views.of == "object":
        raise ValueError("views.of=object: two partial clouds do not show the complete object; expected views.of = source, target or both")
    clouds = ["source", "target"] if views.of == "both" else [views.of]
    return np.stack([render_views(pair[c], layout=views.layout, count=views.count, size=views.size, fit=True) for c in clouds])


def black(views: ViewsConfig) -> np.ndarray:
    """Return black views `[S, V, H, W]` uint8."""
    return np.zeros((views.sets, views.count, views.size, views.size), np.uint8)


def in_categories(labels: np.ndarray, categories: Sequence[str], which: Categories, exclude: Collection[str] = ()) -> np.ndarray:
    """Return the indices `[m]` of the objects whose label is in the named half of the categories and whose category is not excluded.

    The halves are those of all categories, whatever is excluded. Points, labels and views are selected by these same indices, so images
    cannot come from other objects.

    Raises:
        ValueError: an excluded name that is not a category.
    """
    if unknown := sorted(set(exclude) - set(categories)):
        raise ValueError(f"data.exclude: {', '.join(unknown)}: expected names of categories, which are {', '.join(categories)}")
    half = len(categories) // 2
    keep = {"all": labels >= 0, "first-half": labels < half, "second-half": labels >= half}[which]
    left_out = [label for label, name in enumerate(categories) if name in exclude]
    return np.flatnonzero(keep & ~np.isin(labels, left_out))


def training_objects(objects: Shards, data: DataConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of the objects of `data.categories` to train on, and of those held out for validation, `[m]` each.

    Args:
        objects: of the training split.
        data: its categories, and what `split_validation` reads.

    Raises:
        ValueError: fewer than two objects in these categories.
    """
    chosen = in_categories(objects.labels, objects.categories, data.categories, data.exclude)
    if len(chosen) < 2:
        where = f"data.categories={data.categories} without data.exclude={data.exclude}"
        raise ValueError(f"{objects.folder}: expected at least 2 training objects in {where}, got {len(chosen)}")
    return split_validation(chosen, objects.names, data.validation, data.test_seed)


def evenly_spaced(count: int, limit: int | None) -> np.ndarray:
    """Return `limit` positions of `count`, evenly spaced; all of them where the limit is None, or more.

    Raises:
        ValueError: the limit is below 1.
    """
    if limit is None:
        return np.arange(count)
    if limit < 1:
        raise ValueError(f"limit = {limit}: expected at least 1 pair")
    return np.unique(np.linspace(0, count - 1, min(limit, count)).astype(int))


def split_validation(indices: np.ndarray, names: Sequence[str], share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Split training objects into training and validation, `[m]` each.

    An object is held out if a number drawn from (seed, its name) is among the smallest, so other objects have little influence.

    Args:
        indices: `[m]` numbers of the objects to split.
        names: names of all objects.
        share: share to hold out; at least one object is held out.
        seed: seed of the draw.

    Raises:
        ValueError: fewer than two objects.
    """
    if len(indices) < 2:
        raise ValueError(f"expected at least 2 training objects, one of them for validation, got {len(indices)}")
    held = min(max(1, round(len(indices) * share)), len(indices) - 1)
    # Not the generator of the pair: its first number is the angle about x, so the pairs of the objects held out would turn least.
    order = np.argsort([seeded(seed, f"validation: {names[i]}").random() for i in indices], kind="stable")
    return np.sort(indices[order[held:]]), np.sort(indices[order[:held]])
