"""What a network matched in a pair: its keypoints and correspondences in the last iteration (Sec. III-D and III-E)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cmig_jax.data.loader import stack
from cmig_jax.data.pairs import Pair
from cmig_jax.registration import Network
from cmig_jax.training.mesh import to_device

PER_CALL = 4  # pairs


@dataclass(frozen=True)
class Matches:
    """The correspondences of one pair.

    Attributes:
        source: `[K, 3]` source keypoints, as observed.
        target: `[K, 3]` target keypoints, as observed.
        chosen: `[K]` position among the target keypoints of each source keypoint's correspondent.
        used: `[K]` bool, whether the pose counts it: its weight is above 0 (Eq. 10).
        right: `[K]` bool, whether it lies within the match threshold of the source keypoint under the true pose.
    """

    source: NDArray[np.float32]
    target: NDArray[np.float32]
    chosen: NDArray[np.int64]
    used: NDArray[np.bool_]
    right: NDArray[np.bool_]


def matches(network: Network, pairs: Sequence[Pair], distance: float, *, progress: bool = False) -> list[Matches | None]:
    """Return what the network matches in each pair; None where its head has no correspondences (pcrnet).

    Args:
        network: a trained network.
        pairs: of equal shapes.
        distance: the match threshold, object units.
        progress: show a bar.
    """
    found: list[Matches | None] = []
    for start in tqdm(range(0, len(pairs), PER_CALL), desc="correspondences", disable=not progress):
        group = list(pairs[start : start + PER_CALL])
        filled = group + [group[-1]] * (PER_CALL - len(group))  # one compiled shape
        prediction = network.predictor.apply(network.variables, to_device(stack(filled)))
        found += [_of_pair(pair, prediction, i, distance) for i, pair in enumerate(group)]
    return found


def _of_pair(pair: Pair, prediction: Any, i: int, distance: float) -> Matches | None:
    last = prediction.iterations[-1]
    if last.correspondence is None:
        return None
    source = pair["source"][np.asarray(prediction.keypoints.source_index[i])]
    target = pair["target"][np.asarray(prediction.keypoints.target_index[i])]
    chosen = np.asarray(last.correspondence[i], np.int64)
    offset = source @ pair["R"].T + pair["t"] - target[chosen]
    return Matches(
        source=source,
        target=target,
        chosen=chosen,
        used=np.asarray(last.weight[i]) > 0,
        right=np.linalg.norm(offset, axis=1) < distance,
    )
