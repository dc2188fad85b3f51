"""Two clouds of a user's own in, one transform out."""

from __future__ import annotations

import functools
import operator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmig_jax import baselines
from cmig_jax.clouds import check_cloud, thinned
from cmig_jax.config import Needs
from cmig_jax.data.pairs import Pair, render_clouds
from cmig_jax.data.sample import normalise_pair
from cmig_jax.inference.load import Network, load
from cmig_jax.transform import RigidTransform, check_transform

Floats = NDArray[np.float64]
DENSE = 300
"""From this many points on, the 20 neighbours of a point lie on one plane, and generalised ICP is more precise than ICP (384 points:
recall 56 % against 45; 144: 33 against 50)."""


@functools.cache
def _pretrained() -> Network:
    return load()


def register(
    source: ArrayLike, target: ArrayLike, network: Network | None = None, *, points: int | None = None, refine: bool = True
) -> RigidTransform:
    """Find the rigid transform that takes one cloud onto another.

    The clouds may differ in size, density and unit, and may overlap in part. They are centred and scaled together to the unit sphere,
    thinned to the number of points that the network was trained on (at random, but always the same), and rendered for its image branch.
    The network was trained on rotations of up to `data.max_angle_deg` about each axis, to the side or sides that `data.turn` says;
    larger ones are not found. The first call for clouds of some size compiles; clouds above `points` share one size.

    Args:
        source: `[N, 3]`, in any unit.
        target: `[M, 3]`, in the same unit.
        network: of `load`; by default the one that comes with the package, which was trained on generated objects.
        points: points per cloud to keep at most; by default what the network was trained on. Larger clouds take longer.
        refine: then refine the pose on the whole clouds, by generalised ICP, or by point-to-point ICP if one has fewer than `DENSE`
            points. (For clouds that share their points, ICP is the better one; `cmig_jax.baselines` has both.)

    Returns:
        target_from_source, NumPy float64, in the unit of the clouds.

    Raises:
        ValueError: a cloud that is empty, not `[N, 3]` numbers, not finite, with all points on one line, or with fewer points than the
            network's neighbours or keypoints; `points` below these; a network that needs images of complete objects, or clouds of equal
            size.
    """
    network = _pretrained() if network is None else network
    if not isinstance(network, Network):
        raise ValueError(f"network = {network!r}: expected what `load` returns")
    config, needs = network.config, network.config.model.needs
    normalised = normalise_pair(_checked(source, "source", needs), _checked(target, "target", needs))
    count = config.data.cropped_points if points is None else operator.index(points)
    if count < needs.points:
        raise ValueError(f"points = {count}: expected at least {needs.points}, which the network needs")
    fewer_source, fewer_target = thinned(normalised.source, count, seed=0), thinned(normalised.target, count, seed=1)
    if needs.equal_sizes and len(fewer_source) != len(fewer_target):
        raise ValueError(f"clouds of {len(fewer_source)} and {len(fewer_target)} points: expected equal sizes, which the network needs")
    pair: Pair = {"source": fewer_source.astype(np.float32), "target": fewer_target.astype(np.float32)}
    if needs.views:
        pair["views"] = render_clouds(pair, config.views)
    estimated = network([pair])[0]
    pose = check_transform(estimated.R, estimated.t, network.title)
    if refine:
        dense = min(len(normalised.source), len(normalised.target)) >= DENSE
        pose = (baselines.refine_by_gicp if dense else baselines.refine_by_icp)(normalised.source, normalised.target, pose)
    return RigidTransform(R=pose.R, t=normalised.original_translation(pose.R, pose.t))


def _checked(points: ArrayLike, name: str, needs: Needs) -> Floats:
    """Return a user's cloud, which must determine a rotation."""
    cloud = check_cloud(points, name)
    if len(cloud) < needs.points:
        raise ValueError(f"{name} has {len(cloud)} points: expected at least {needs.points}, which the network needs")
    given = np.asarray(points).dtype
    spread = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    rounding = np.finfo(given).eps if given.kind == "f" else 0.0
    if spread[1] <= max(1e-9, 16 * rounding) * max(spread[0], np.abs(cloud).max()):
        raise ValueError(f"{name}: all points are equal or on one line, which leaves the rotation open; expected a surface")
    return cloud
