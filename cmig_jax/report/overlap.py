"""How much of a pair's source its target shows: what the report orders and plots errors by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

from cmig_jax.data.pairs import Pair


class Measured:
    """Pairs that are measured as they pass, so that none is made twice.

    Args:
        pairs: to be read once.
        distance: as in `overlap`.

    Attributes:
        overlaps: of the pairs that were read, in their order.
    """

    def __init__(self, pairs: Sequence[Pair], distance: float) -> None:
        self._pairs, self._distance = pairs, distance
        self.overlaps: list[float] = []

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[Pair]:
        self.overlaps.clear()
        for i in range(len(self._pairs)):
            pair = self._pairs[i]
            self.overlaps.append(overlap(pair["source"], pair["target"], pair["R"], pair["t"], self._distance))
            yield pair


def overlap(source: ArrayLike, target: ArrayLike, R: ArrayLike, t: ArrayLike, distance: float) -> float:
    """Return the share of source points that have a correspondent: a target point closer than a distance under the true pose.

    Clouds that were sampled independently overlap less by this measure the sparser they are, as there is less to be matched.

    Args:
        source: `[N, 3]` as observed.
        target: `[M, 3]` as observed.
        R: `[3, 3]` true rotation, target_from_source.
        t: `[3]` true translation.
        distance: in the clouds' unit; the report takes the match threshold (`loss.match_threshold`).

    Returns:
        A share in [0, 1].
    """
    moved = np.asarray(source, np.float64) @ np.asarray(R, np.float64).T + np.asarray(t, np.float64)
    return float(np.mean(KDTree(np.asarray(target, np.float64)).query(moved)[0] < distance))
