"""Two clouds of a user's own in, one transform out: owns scale, sampling, views and batching."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from cmig_jax import baselines
from cmig_jax.config import Config
from cmig_jax.data.pairs import Pair
from cmig_jax.data.render import render_views
from cmig_jax.nn.build import build, uses_images
from cmig_jax.structs import RigidTransform
from cmig_jax.training.checkpoint import differences, load_state, read_config
from cmig_jax.training.mesh import device_mesh
from cmig_jax.training.optim import optimizer
from cmig_jax.training.predict import Predictor
from cmig_jax.training.state import abstract_state
from cmig_jax.weights import PRETRAINED, check_variables, read_weights

Floats = NDArray[np.float64]
DENSE = 300
"""From so many points on, a point's 20 neighbours show its plane, and generalised ICP is more precise than ICP (384 points: recall 56 %
against 45; 144: 33 against 50)."""


@dataclass(frozen=True)
class Network:
    """A trained network.

    Attributes:
        config: the flags it was trained with.
        variables: parameters and running statistics.
        predictor: its compiled evaluation.
        step: training steps behind it.
    """

    config: Config
    variables: dict[str, Any]
    predictor: Predictor
    step: int

    def __call__(self, pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray]:
        """Register prepared pairs (`data.pairs`, with views where the network uses them): R `[n, 3, 3]`, t `[n, 3]`."""
        return self.predictor(self.variables, pairs)

    @property
    def points(self) -> int:
        """Points per cloud that the network was trained on."""
        data = self.config.data
        return data.points if data.crop == "none" else round(data.points * data.keep)


def load(
    source: str | Path | None = None, which: Literal["best", "last"] = "best", batch: int = 1, *, config: Config | None = None
) -> Network:
    """Load a trained network.

    Args:
        source: a run folder of `train.py`, a weights file (`cmig_jax.weights`), or None for the network that comes with the package.
        which: checkpoint of a run folder: the best on validation (the last, if none was validated yet), or the last.
        batch: pairs per compiled call.
        config: flags to use in place of those of the training, such as other keypoints, precision or chunks; the weights must fit.

    Raises:
        ValueError: no run folder, no checkpoint in it, or one that does not fit its config; the message names the file. Or a `batch`
            or `which` that is none.
    """
    if batch < 1 or which not in ("best", "last"):
        raise ValueError(f"batch = {batch}, which = {which!r}: expected at least 1, and best or last")
    path = PRETRAINED if source is None else Path(source)
    if path.suffix == ".npz":
        trained, step, variables = read_weights(path)
        config = config or trained
        model = build(config)
        like = abstract_state(model, optimizer(config.optim, 1), config, device_mesh(1, 1))
        check_variables(variables, like.variables, str(path))
        return Network(config=config, variables=variables, predictor=Predictor(model, batch), step=step)
    trained = read_config(path)
    config = config or trained
    model = build(config)
    like = abstract_state(model, optimizer(config.optim, 1), config, device_mesh(1, 1))
    try:
        state = load_state(path, like, which)
    except ValueError as error:
        if changed := [flag for flag in differences(trained, config) if flag.startswith("model.")]:
            raise ValueError(f"{error}; the weights were trained before {'; '.join(changed)}") from error
        raise
    return Network(config=config, variables=state.variables, predictor=Predictor(model, batch), step=int(state.step))


@functools.cache
def _pretrained() -> Network:
    return load()


def register(
    source: ArrayLike, target: ArrayLike, network: Network | None = None, *, points: int | None = None, refine: bool = False
) -> RigidTransform:
    """Find the rigid transform that takes one cloud onto another.

    The clouds may differ in size, density and units, and may overlap in part. They are centred and scaled together to the unit
    sphere, thinned to the number of points that the network knows (the choice is random but always the same), and rendered for its
    image branch. The network was trained on rotations of up to `data.max_angle_deg` about each axis, to the side or sides that
    `data.turn` says: expect no more of it. The first call for clouds of some size compiles; clouds above `points` share one size.

    Args:
        source: `[N, 3]`, in any unit.
        target: `[M, 3]`, in the same unit.
        network: of `load`; by default the one that comes with the package, which was trained on generated objects.
        points: points per cloud to keep at most; by default what the network was trained on. Larger clouds cost more.
        refine: finish with generalised ICP on the whole clouds, or point-to-point ICP if one has fewer than `DENSE` points, which
            sharpens a good pose. (For clouds that share their points, ICP is the better one, and `cmig_jax.baselines` has both.)

    Returns:
        target_from_source, NumPy arrays R `[3, 3]` and t `[3]` in the unit of the clouds.

    Raises:
        ValueError: a cloud that is empty, not `[N, 3]` numbers, not finite, with all points on one line, or with fewer points than the
            network's neighbours or keypoints; `points` below these; a network that needs images of complete objects, or clouds of equal
            size, and has none.
    """
    network = _pretrained() if network is None else network
    if not isinstance(network, Network):
        raise ValueError(f"network = {network!r}: expected what `load` returns")
    x, y = _cloud(source, "source", network.config), _cloud(target, "target", network.config)
    centre_x, centre_y = x.mean(axis=0), y.mean(axis=0)
    scale = max(np.linalg.norm(x - centre_x, axis=1).max(), np.linalg.norm(y - centre_y, axis=1).max())
    count = network.points if points is None else operator.index(points)
    if count < (fewest := _fewest_points(network.config)):
        raise ValueError(f"points = {count}: expected at least {fewest}, the network's neighbours and keypoints")
    x, y = (x - centre_x) / scale, (y - centre_y) / scale
    pair = {"source": _thinned(x, count, seed=0).astype(np.float32), "target": _thinned(y, count, seed=1).astype(np.float32)}
    if uses_images(network.config):
        pair["views"] = _views(pair, network.config)
    R, t = (np.asarray(v[0], np.float64) for v in network([pair]))
    R = Rotation.from_matrix(R).as_matrix()  # single precision's is a rotation to 1e-6 only
    if refine:
        finish = baselines.finish_by_gicp if min(len(x), len(y)) >= DENSE else baselines.finish_by_icp
        R, t = finish(x, y, (R, t))
    return RigidTransform(R=R, t=centre_y + scale * t - R @ centre_x)  # type: ignore[arg-type]


def _cloud(points: ArrayLike, name: str, config: Config) -> Floats:
    """Check a user's cloud."""
    if np.ma.is_masked(points):
        raise ValueError(f"{name} has masked points: expected them to be left out")
    try:
        given = np.asarray(points)
    except ValueError as error:
        raise ValueError(f"{name}: expected numbers [N, 3] ({error})") from error
    if given.dtype.kind not in "iuf":
        raise ValueError(f"{name} has dtype {given.dtype}: expected numbers [N, 3]")
    cloud = given.astype(np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"{name} has shape {cloud.shape}: expected [N, 3]")
    fewest = _fewest_points(config)
    if len(cloud) < fewest:
        raise ValueError(f"{name} has {len(cloud)} points: expected at least {fewest}, the network's neighbours and keypoints")
    bad = np.flatnonzero(~np.isfinite(cloud).all(axis=1))
    if len(bad):
        raise ValueError(f"{name}[{bad[0]}] = {cloud[bad[0]]}: expected finite coordinates ({len(bad)} points are not)")
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    rounding = np.finfo(given.dtype).eps if given.dtype.kind == "f" else 0.0
    if spread[1] <= max(1e-9, 16 * rounding) * max(spread[0], np.abs(cloud).max()):
        raise ValueError(f"{name}: all points are equal or on one line, which leaves the rotation open; expected a surface")
    return cloud


def _fewest_points(config: Config) -> int:
    keypoints = config.model.keypoints
    return max(config.model.points.k, 3 if keypoints.select == "all" or keypoints.test_count else keypoints.count)


def _thinned(cloud: Floats, count: int, seed: int) -> Floats:
    """Keep `count` random points of a larger cloud, the same ones every time."""
    if len(cloud) <= count:
        return cloud
    return cloud[np.sort(np.random.default_rng(seed).choice(len(cloud), count, replace=False))]


def _views(pair: Pair, config: Config) -> np.ndarray:
    views = config.views
    if views.of == "object":
        raise ValueError(
            "this network was trained on images of the complete object (views.of=object), which two partial clouds do not give: "
            "train with views.of=both"
        )
    clouds = {"source": ["source"], "target": ["target"], "both": ["source", "target"]}[views.of]
    return np.stack([render_views(pair[c], layout=views.layout, count=views.count, size=views.size, fit=True) for c in clouds])
