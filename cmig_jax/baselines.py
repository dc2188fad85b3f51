"""Registration without learning, to compare the network with (Sec. IV-A): the identity and point-to-point ICP from the identity.

Every baseline takes a source `[N, 3]` and a target `[M, 3]` and returns `target_from_source`: R `[3, 3]`, t `[3]`, float64. One pair
runs on one thread.
"""

from __future__ import annotations

import numpy as np
import small_gicp
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Pose = tuple[Floats, Floats]


def identity(source: ArrayLike, target: ArrayLike) -> Pose:
    """Return the pose that moves nothing: the size of the task.

    Args:
        source: `[N, 3]` points.
        target: `[M, 3]` points.

    Returns:
        R `[3, 3]` and t `[3]`.

    Raises:
        ValueError: a cloud with fewer than 3 points, another shape, or coordinates that are not finite.
    """
    _cloud(source, "source")
    _cloud(target, "target")
    return np.eye(3), np.zeros(3)


def icp_cutoff(source: ArrayLike, target: ArrayLike) -> Pose:
    """Register by ICP as many comparisons run it: pairs of points farther apart than 0.02 are ignored, 30 iterations.

    From a start as far off as the paper's it finds next to no pairs of points and stays where it was; `icp_tuned` is the fair row.
    Arguments, result and errors are those of `icp`.
    """
    return icp(source, target, max_distance=0.02, iterations=30)


def icp_tuned(source: ArrayLike, target: ArrayLike) -> Pose:
    """Register by ICP at its best: without a cutoff until it stands still, then with a cutoff of 0.1.

    The second round lets go of the points that the crop left without a partner. Chosen among twelve schedules on 300 training objects
    of the second half of the categories (1,024 points cropped to 768, noise 0.01, Sec. IV-B); RMSE(R) / MAE(R) / recall, and per pair:

    ===============================  ====================  ======
    0.02 (`icp_cutoff`)              26.1 / 22.2 / 0.00    1.0 ms
    none, 20 iterations, 1e-3        11.2 / 5.45 / 0.43    3.2 ms
    none, 500 iterations             9.01 / 2.31 / 0.87    6.0 ms
    0.5                              9.77 / 2.45 / 0.87    6.2 ms
    0.1                              23.3 / 13.1 / 0.40    9.6 ms
    **none, then 0.1**               9.28 / 1.98 / 0.90    6.8 ms
    none, 0.3, 0.1                   9.28 / 1.97 / 0.90    6.8 ms
    none, 0.5, 0.2, 0.1, 0.05        11.1 / 2.14 / 0.90    7.7 ms
    ===============================  ====================  ======

    With a crop for each cloud on its own: 15.9 / 6.79 / 0.49, against 16.4 / 8.32 / 0.38 without the second round.
    Arguments, result and errors are those of `icp`.
    """
    return icp(source, target, max_distance=0.1, start=icp(source, target, max_distance=None))


def icp(
    source: ArrayLike,
    target: ArrayLike,
    *,
    max_distance: float | None,
    iterations: int = 200,
    tolerance: float = 1e-6,
    start: Pose | None = None,
) -> Pose:
    """Register by point-to-point ICP (small_gicp).

    Args:
        source: `[N, 3]` points.
        target: `[M, 3]` points.
        max_distance: pairs of points farther apart than this are ignored, in the clouds' unit; None ignores none.
        iterations: at most this many.
        tolerance: stop when a step turns by less than this (radians) and moves by less than this.
        start: R and t to start from; the identity by default.

    Returns:
        R `[3, 3]` and t `[3]`; the start itself where no pair of points is closer than `max_distance`.

    Raises:
        ValueError: a cloud with fewer than 3 points, another shape, or coordinates that are not finite; a setting out of range.
    """
    source, target = _cloud(source, "source"), _cloud(target, "target")
    if max_distance is not None and not max_distance > 0:
        raise ValueError(f"max_distance = {max_distance}: expected a length above 0, or None")
    if iterations < 1 or not tolerance > 0:
        raise ValueError(f"iterations = {iterations}, tolerance = {tolerance}: expected at least 1, and above 0")
    T = np.eye(4)
    if start is not None:
        T[:3, :3], T[:3, 3] = start
    moved = small_gicp.align(
        small_gicp.PointCloud(target),
        small_gicp.PointCloud(source),
        init_T_target_source=T,
        registration_type="ICP",
        max_correspondence_distance=np.inf if max_distance is None else max_distance,
        num_threads=1,
        max_iterations=iterations,
        rotation_epsilon=tolerance,
        translation_epsilon=tolerance,
    )
    # Without a single pair of points its normal equations are empty, and what it returns is undefined.
    T = T if moved.num_inliers == 0 else moved.T_target_source
    return T[:3, :3].copy(), T[:3, 3].copy()


def _cloud(points: ArrayLike, name: str) -> Floats:
    try:
        cloud = np.asarray(points, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected [points, 3] numbers ({error})") from error
    if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) < 3:
        raise ValueError(f"{name} of shape {cloud.shape}: expected [points, 3] with at least 3 points")
    for i in np.flatnonzero(~np.isfinite(cloud).all(1)):
        raise ValueError(f"{name}: point {i} is {cloud[i].tolist()}, expected finite coordinates")
    return np.ascontiguousarray(cloud)
