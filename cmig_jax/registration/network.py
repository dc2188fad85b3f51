"""The pose that a network finds for a user's clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmig_jax.clouds import thinned
from cmig_jax.data.normals import observed_normals
from cmig_jax.data.pairs import Pair, render_clouds
from cmig_jax.data.sample import normalise_pair
from cmig_jax.inference.load import Network
from cmig_jax.transform import RigidTransform, check_transform

Floats = NDArray[np.float64]


def network_pose(network: Network, source: Floats, target: Floats) -> RigidTransform:
    """Return target_from_source as a network finds it.

    The clouds are centred and scaled together to the unit sphere, thinned to the number of points that the network was trained on (at
    random, but always the same), and rendered for its image branch. Normals are estimated before the clouds are thinned. A network finds
    rotations as large as those that it was trained on (`data.max_angle_deg` about each axis, to the side or sides that `data.turn` says,
    or `data.max_twist`).

    Raises:
        ValueError: fewer points than the network needs; clouds of unequal sizes, or no images of complete objects, where it needs them.
    """
    config, needs = network.config, network.config.model.needs
    for name, cloud in (("source", source), ("target", target)):
        if len(cloud) < needs.points:
            raise ValueError(f"{name} has {len(cloud)} points: expected at least {needs.points}, which the network needs")
    normalised = normalise_pair(source, target)
    clouds = (
        thinned(normalised.source, config.data.cropped_points, seed=0),
        thinned(normalised.target, config.data.target_points, seed=1),
    )
    if needs.equal_sizes and len(clouds[0]) != len(clouds[1]):
        raise ValueError(f"clouds of {len(clouds[0])} and {len(clouds[1])} points: expected equal sizes, which the network needs")
    pair: Pair = {"source": clouds[0].astype(np.float32), "target": clouds[1].astype(np.float32)}
    if needs.normals:
        pair["source_normals"] = observed_normals(normalised.source, clouds[0])
        pair["target_normals"] = observed_normals(normalised.target, clouds[1])
    if needs.views:
        pair["views"] = render_clouds(pair, config.views)
    found = network([pair])[0]
    pose = check_transform(found.R, found.t, network.title)
    return RigidTransform(R=pose.R, t=normalised.original_translation(pose.R, pose.t))
