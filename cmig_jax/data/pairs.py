"""Objects to pairs: pose, noise, crop (Sec. IV-B and IV-C), as the paper's experiments and the released loader make them.

A pair is a dict of arrays: `source [N, 3]`, `target [M, 3]`, `R [3, 3]`, `t [3]` with `target = R source + t`, `views [S, V, H, W]`
uint8, `object [P, 3]` the complete clean object in the source's frame, `label` and `index`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Literal, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from cmig_jax.config import Categories, Config, DataConfig, ViewsConfig
from cmig_jax.data.recordings import SOURCES as RECORDED
from cmig_jax.data.render import render_views

Pair = dict[str, Any]
FAR = 500.0  # distance factor of the crop's far point: from there, "nearest" is a half-space to within rounding
SYMMETRIC = ("bottle", "bowl", "cone", "cup", "flower_pot", "lamp", "tent", "vase")
"""ModelNet40's categories whose objects turn into themselves: without them 32 are left, a protocol of the literature (`data.exclude`)."""


class Objects(Protocol):
    """What pairs are made of: `data.shards.Shards`, or anything like it."""

    @property
    def labels(self) -> np.ndarray:
        """Category of each object `[n]`."""
        ...

    @property
    def categories(self) -> Sequence[str]:
        """Names of the categories."""
        ...

    def points(self, i: int) -> np.ndarray:
        """Surface points `[P, 3]` in the unit sphere."""
        ...

    def views(self, i: int) -> np.ndarray | None:
        """Views `[V, H, W]` rendered ahead of time, or None."""
        ...


class Pairs(Sequence[Pair]):
    """A fixed list of pairs: pair i is a function of (seed, i) alone, whatever the order or the machine.

    Args:
        objects: where they come from.
        indices: `[n]` which objects.
        config: `data` and `views` flags.
        seed: of poses, crops and noise.
        views: whether to attach images.
    """

    def __init__(self, objects: Objects, indices: np.ndarray, config: Config, seed: int, views: bool = True) -> None:
        self.objects, self.indices, self.config, self.seed, self.with_views = objects, indices, config, seed, views

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: int) -> Pair:  # type: ignore[override]
        if not -len(self) <= position < len(self):
            raise IndexError(position)
        return self.draw(position % len(self), np.random.default_rng([self.seed, position % len(self)]))

    @property
    def categories(self) -> Sequence[str]:
        """Names of the categories that `label` counts."""
        return self.objects.categories

    def draw(self, position: int, rng: np.random.Generator) -> Pair:
        """Make a pair of the object at `position` with random numbers of the caller's; `views.shown` changes nothing but its views."""
        pair = make_pair(self.objects, int(self.indices[position]), self.config.data, rng)
        if self.with_views:
            pair["views"] = self._shown(pair, rng)
        return pair

    def _shown(self, pair: Pair, rng: np.random.Generator) -> np.ndarray:
        """Return the views that `views.shown` asks for; `rng` has made the pair, so that drawing on cannot change it."""
        views = self.config.views
        if views.shown == "zero":
            return black(views)
        if views.shown == "shuffled":
            others = self.indices[self.indices != pair["index"]]
            if len(others) == 0:
                raise ValueError(f"views.shown=shuffled with object {pair['index']} alone: expected at least one other object")
            pair = make_pair(self.objects, int(rng.choice(others)), self.config.data, rng)
        return observe(self.objects, pair, views)


def make_pair(objects: Objects, index: int, data: DataConfig, rng: np.random.Generator) -> Pair:
    """Draw a pair of one object (without views).

    Args:
        objects: the data set.
        index: object.
        data: the protocol's flags.
        rng: source of pose, order, noise and crop.

    Raises:
        ValueError: the object has too few points for `data.points` and `data.sampling`.
    """
    points = objects.points(index)
    source, target = samplings(points, data.points, data.sampling, index, rng)
    R, t = random_pose(rng, data.max_angle_deg, data.max_translation, data.turn)
    clouds = [source, target @ R.T + t]
    clouds = [cloud[rng.permutation(len(cloud))] for cloud in clouds]
    if data.noise_std > 0:
        clouds = [c + np.clip(rng.normal(0, data.noise_std, c.shape), -data.noise_clip, data.noise_clip) for c in clouds]
    source, target = crop(clouds[0], clouds[1], data.crop, data.keep, rng)
    return {
        "source": source.astype(np.float32),
        "target": target.astype(np.float32),
        "R": R.astype(np.float32),
        "t": t.astype(np.float32),
        "object": np.asarray(points, np.float32),
        "label": np.int32(objects.labels[index]),
        "index": np.int32(index),
    }


def samplings(
    points: np.ndarray, count: int, sampling: Literal["once", "twice", "subsets"], index: int = 0, rng: np.random.Generator | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the clean points of both clouds, `[count, 3]` each.

    `once`: the first `count` points twice. `twice`: the first and the last. `subsets`: two random subsets of all points, as RPM-Net
    draws them (Yew and Lee, CVPR 2020), for which `rng` is needed.

    Raises:
        ValueError: fewer points than that, naming the object's `index`.
    """
    needed = 2 * count if sampling == "twice" else count
    if len(points) < needed:
        raise ValueError(
            f"object {index} has {len(points)} points: expected at least {needed} for data.points={count}, sampling={sampling}"
        )
    if sampling == "subsets":
        assert rng is not None
        first, second = (rng.choice(len(points), count, replace=False) for _ in range(2))
        return points[first], points[second]
    return points[:count], points[:count] if sampling == "once" else points[-count:]


def random_pose(
    rng: np.random.Generator, max_angle_deg: float, max_translation: float, turn: Literal["positive", "either"] = "positive"
) -> tuple[np.ndarray, np.ndarray]:
    """Draw R = Rx Ry Rz `[3, 3]`, each angle uniform in [0 or -max, max] degrees, and t `[3]` uniform in [-max, max]."""
    x, y, z = rng.uniform(-max_angle_deg if turn == "either" else 0, max_angle_deg, 3)
    R = Rotation.from_euler("zyx", [z, y, x], degrees=True).as_matrix()
    return R, rng.uniform(-max_translation, max_translation, 3)


def mean_angle_deg(data: DataConfig) -> float:
    """Return the mean of each of the three angles that `random_pose` draws; 0 for recorded pairs, which turn to either side."""
    return 0.0 if data.turn == "either" or data.source in RECORDED else data.max_angle_deg / 2


def crop(
    source: np.ndarray,
    target: np.ndarray,
    kind: Literal["shared", "independent", "half-space", "none"],
    keep: float,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray]:
    """Keep of each cloud `[N, 3]` the share `keep`.

    `shared`, `independent`: what is nearest to a far point, the same for both or one each (lower overlap). `half-space`: what lies on
    one side of a plane, one each, its normal uniform on the sphere (RPM-Net; there the cut comes before the noise, here after it).
    """
    if kind == "none":
        return source, target
    if kind == "half-space":
        first, second = (rng.normal(size=3) for _ in range(2))
        return keep_farthest_along(source, first, keep), keep_farthest_along(target, second, keep)
    first = far_point(rng)
    second = first if kind == "shared" else far_point(rng)
    return keep_nearest(source, first, keep), keep_nearest(target, second, keep)


def far_point(rng: np.random.Generator) -> np.ndarray:
    """Draw u + 500 s (1, 1, 1), u uniform in [0, 1]^3, s = +-1."""
    return rng.uniform(0, 1, 3) + FAR * rng.choice([-1.0, 1.0])


def keep_nearest(points: np.ndarray, centre: np.ndarray, keep: float) -> np.ndarray:
    """Keep the round(keep * N) points of `[N, 3]` nearest to `centre [3]`, in their order."""
    count = round(len(points) * keep)
    distance = np.sum((points.astype(np.float64) - centre) ** 2, axis=1)
    return points[np.sort(np.argpartition(distance, count - 1)[:count])]


def keep_farthest_along(points: np.ndarray, direction: np.ndarray, keep: float) -> np.ndarray:
    """Keep the round(keep * N) points of `[N, 3]` that lie farthest along `direction [3]`, in their order."""
    count = round(len(points) * keep)
    depth = -points.astype(np.float64) @ direction
    return points[np.sort(np.argpartition(depth, count - 1)[:count])]


def observe(objects: Objects, pair: Pair, views: ViewsConfig) -> np.ndarray:
    """Return the depth views of a pair `[S, V, H, W]` uint8: those of the object, or rendered from what the sensor saw.

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
    """Render what the sensor saw, `[S, V, H, W]` uint8: the source, the target, or each, as `views.of` says."""
    clouds = {"source": ["source"], "target": ["target"], "both": ["source", "target"]}[views.of]
    return np.stack([render_views(pair[c], layout=views.layout, count=views.count, size=views.size, fit=True) for c in clouds])


def black(views: ViewsConfig) -> np.ndarray:
    """Return views `[S, V, H, W]` uint8 of nothing."""
    return np.zeros((2 if views.of == "both" else 1, views.count, views.size, views.size), np.uint8)


def in_categories(labels: np.ndarray, categories: Sequence[str], which: Categories, exclude: Collection[str] = ()) -> np.ndarray:
    """Return the indices `[m]` of the objects whose label is in the named half of the categories and whose category is not excluded.

    The halves are those of all categories, whatever is excluded. Points, labels and views are picked by these same indices, so images
    cannot come from other objects.

    Raises:
        ValueError: an excluded name that is no category.
    """
    if unknown := sorted(set(exclude) - set(categories)):
        raise ValueError(f"data.exclude: {', '.join(unknown)}: expected names of categories, which are {', '.join(categories)}")
    half = len(categories) // 2
    keep = {"all": labels >= 0, "first-half": labels < half, "second-half": labels >= half}[which]
    left_out = [label for label, name in enumerate(categories) if name in exclude]
    return np.flatnonzero(keep & ~np.isin(labels, left_out))


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


def split_validation(indices: np.ndarray, share: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Split training objects into training and validation, `[m]` each, by a permutation that depends on the seed alone.

    Raises:
        ValueError: fewer than two objects.
    """
    if len(indices) < 2:
        raise ValueError(f"expected at least 2 training objects, one of them for validation, got {len(indices)}")
    held = min(max(1, round(len(indices) * share)), len(indices) - 1)
    order = np.random.default_rng([seed, len(indices)]).permutation(len(indices))
    return np.sort(indices[order[held:]]), np.sort(indices[order[:held]])
