"""The overlap of two clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import KDTree

MOST_POINTS = 5000  # of each cloud are compared, evenly spaced, which determines the share to about 0.01


def overlap(source: ArrayLike, target: ArrayLike, R: ArrayLike, t: ArrayLike, distance: float) -> float:
    """Return the share of a cloud's points with a point of the other cloud closer than `distance`, for the cloud where it is smaller.

    For clouds that were sampled independently, this measure decreases with their density.

    Args:
        source: `[N, 3]`.
        target: `[M, 3]`, the same unit.
        R: `[3, 3]` true rotation, target_from_source.
        t: `[3]` true translation.
        distance: largest distance of corresponding points, the same unit.

    Returns:
        A share in [0, 1].
    """
    moved = np.asarray(source, np.float64) @ np.asarray(R, np.float64).T + np.asarray(t, np.float64)
    fixed, shares = np.asarray(target, np.float64), []
    for one, other in ((moved, fixed), (fixed, moved)):
        found, _ = KDTree(other, balanced_tree=False).query(one[:: 1 + len(one) // MOST_POINTS], distance_upper_bound=distance)
        shares.append(np.mean(found < distance))
    return float(min(shares))
