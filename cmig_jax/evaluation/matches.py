"""What a network matched in a pair: its keypoints and correspondences (Sec. III-D and III-E)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cmig_jax.data.loader import stack
from cmig_jax.data.pairs import Pair
from cmig_jax.devices import to_device
from cmig_jax.evaluation.engine import MATCH_DISTANCE
from cmig_jax.inference.load import Network
from cmig_jax.structs import Correspondences

PER_CALL = 4  # pairs


@dataclass(frozen=True)
class Matches:
    """The correspondences of one pair.

    Attributes:
        source: `[K, 3]` source keypoints, as observed.
        target: `[L, 3]` target keypoints, as observed.
        chosen: `[K]` position among the target keypoints of each source keypoint's correspondent.
        used: `[K]` bool, whether the pose uses it: its weight is above 0 (Eq. 10).
        right: `[K]` bool, whether it lies within `MATCH_DISTANCE` of the source keypoint under the true pose.
    """

    source: NDArray[np.float32]
    target: NDArray[np.float32]
    chosen: NDArray[np.int64]
    used: NDArray[np.bool_]
    right: NDArray[np.bool_]


def matches(network: Network, pairs: Sequence[Pair], *, progress: bool = False) -> list[Matches | None]:
    """Return what the network matches in each pair; None for a network without correspondences.

    Args:
        network: a trained network.
        pairs: of equal shapes.
        progress: show a bar.
    """
    found: list[Matches | None] = []
    for start in tqdm(range(0, len(pairs), PER_CALL), desc="correspondences", disable=not progress):
        group = list(pairs[start : start + PER_CALL])
        filled = group + [group[-1]] * (PER_CALL - len(group))  # one compiled shape
        correspondences = network.predictor.predict(network.variables, to_device(stack(filled))).correspondences
        found += [None if correspondences is None else _of_pair(pair, correspondences, i) for i, pair in enumerate(group)]
    return found


def _of_pair(pair: Pair, correspondences: Correspondences, i: int) -> Matches:
    of_pair: Correspondences = jax.tree.map(lambda x: np.asarray(x[i]), correspondences)
    source, target = pair["source"][of_pair.source_index], pair["target"][of_pair.target_index]
    chosen = np.asarray(of_pair.partner, np.int64)
    offset = source @ pair["R"].T + pair["t"] - target[chosen]
    right = np.linalg.norm(offset, axis=1) < MATCH_DISTANCE
    return Matches(source=source, target=target, chosen=chosen, used=np.asarray(of_pair.weight) > 0, right=right)
