"""Local methods (Sec. IV-A): the identity, and from it, or from a start, point-to-point ICP and generalised ICP (small_gicp).

One pair runs on one thread. Lengths are in the clouds' unit; the tuned settings suit objects normalised to the unit sphere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from cmig_jax.baselines.method import Floats, Pose, as_matrix, as_pose, checked_cloud, no_motion, recorded

TUNED_ROUNDS = (None, 0.1)
"""Cutoffs of the tuned ICP, round by round; the global methods end with the same."""


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
    checked_cloud(source, "source")
    checked_cloud(target, "target")
    return no_motion()


def icp_cutoff(source: ArrayLike, target: ArrayLike) -> Pose:
    """Register by ICP as many comparisons run it: pairs of points farther apart than 0.02 are ignored, 30 iterations.

    From a start as far off as the paper's it finds next to no pairs of points and stays where it was; `icp_tuned` is the fair row.
    Arguments, result and errors are those of `icp`.
    """
    return ICP_CUTOFF.register(source, target)


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
    return ICP_TUNED.register(source, target)


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
    source, target = checked_cloud(source, "source"), checked_cloud(target, "target")
    clouds = small_gicp.PointCloud(source), small_gicp.PointCloud(target)
    return _align(*clouds, "ICP", max_distance, iterations, tolerance, no_motion() if start is None else start)


def gicp(
    source: ArrayLike,
    target: ArrayLike,
    *,
    max_distance: float | None,
    neighbours: int = 20,
    iterations: int = 200,
    tolerance: float = 1e-6,
    start: Pose | None = None,
) -> Pose:
    """Register by generalised ICP (small_gicp): every point has a covariance, so that planes slide on planes.

    It is the more precise on clouds that were sampled on their own, which share a surface but no points, where they are dense enough
    for a point's neighbours to lie on its plane: on objects of 384 points it is, on some of 192 ICP is. Result and errors are those of
    `icp`, and so are the arguments, but for `neighbours`, the points per covariance (the documentation's 20).
    """
    source, target = checked_cloud(source, "source"), checked_cloud(target, "target")
    clouds = _with_covariances(source, neighbours), _with_covariances(target, neighbours)
    return _align(*clouds, "GICP", max_distance, iterations, tolerance, no_motion() if start is None else start)


@dataclass(frozen=True)
class Identity:
    """No registration at all."""

    def register(self, source: ArrayLike, target: ArrayLike) -> Pose:
        """Return the pose that moves nothing."""
        return identity(source, target)

    @property
    def settings(self) -> dict[str, Any]:
        """Nothing to set."""
        return {}


@dataclass(frozen=True)
class Icp:
    """Point-to-point ICP, in rounds that each start where the last one ended.

    Attributes:
        max_distances: cutoff of each round, as `icp` has it.
        iterations, tolerance: of each round.
        start_angle_deg: None starts from the identity. A number starts with the clouds' centres together and this angle about each axis,
            R = Rx Ry Rz, such as the mean of what a protocol draws (`data.pairs.mean_angle_deg`): the paper's angles are uniform in
            [0, 45] degrees, all to one side (Sec. IV-B), so that the identity is a corner of their range. A network learns as much from
            its training pairs.
    """

    max_distances: tuple[float | None, ...] = TUNED_ROUNDS
    iterations: int = 200
    tolerance: float = 1e-6
    start_angle_deg: float | None = None

    def register(self, source: ArrayLike, target: ArrayLike) -> Pose:
        """Register one pair."""
        source, target = checked_cloud(source, "source"), checked_cloud(target, "target")
        start = no_motion()
        if self.start_angle_deg is not None:
            R = Rotation.from_euler("zyx", [self.start_angle_deg] * 3, degrees=True).as_matrix()
            start = R, target.mean(axis=0) - R @ source.mean(axis=0)
        return icp_rounds(source, target, self.max_distances, start, self.iterations, self.tolerance)

    @property
    def settings(self) -> dict[str, Any]:
        """The package, the start and the fields."""
        start = "identity" if self.start_angle_deg is None else "this angle about each axis, centres together"
        return recorded(self, _package(), start=start, threads=1)


def icp_rounds(
    source: ArrayLike,
    target: ArrayLike,
    max_distances: Sequence[float | None],
    start: Pose,
    iterations: int = 200,
    tolerance: float = 1e-6,
) -> Pose:
    """Register by `icp` once per cutoff, each time from where the last one ended."""
    for max_distance in max_distances:
        start = icp(source, target, max_distance=max_distance, iterations=iterations, tolerance=tolerance, start=start)
    return start


ICP_CUTOFF = Icp(max_distances=(0.02,), iterations=30)
ICP_TUNED = Icp()


@dataclass(frozen=True)
class Gicp:
    """Generalised ICP, `gicp`, from the identity.

    It is a method for fine registration and needs a start; like ICP it has none here but the identity. Clouds this small are not
    thinned, and the rounds are those of `icp_tuned`.

    Attributes:
        neighbours: points per covariance.
        max_distances: cutoff of each round, as `icp` has it.
        iterations, tolerance: of each round.
    """

    neighbours: int = 20
    max_distances: tuple[float | None, ...] = TUNED_ROUNDS
    iterations: int = 200
    tolerance: float = 1e-6

    def register(self, source: ArrayLike, target: ArrayLike) -> Pose:
        """Register one pair; a round that finds no pose leaves the one it started from."""
        source, target = checked_cloud(source, "source"), checked_cloud(target, "target")
        clouds = _with_covariances(source, self.neighbours), _with_covariances(target, self.neighbours)
        pose = no_motion()
        for max_distance in self.max_distances:
            pose = _align(*clouds, "GICP", max_distance, self.iterations, self.tolerance, pose)
        return pose

    @property
    def settings(self) -> dict[str, Any]:
        """The package, the start and the fields."""
        return recorded(self, _package(), start="identity", threads=1)


def _with_covariances(points: Floats, neighbours: int) -> small_gicp.PointCloud:
    if neighbours < 3:  # of none, small_gicp ends the process
        raise ValueError(f"neighbours = {neighbours}: expected at least 3, which make a plane")
    cloud = small_gicp.PointCloud(points)
    small_gicp.estimate_covariances(cloud, num_neighbors=neighbours, num_threads=1)
    return cloud


def _align(
    source: small_gicp.PointCloud,
    target: small_gicp.PointCloud,
    kind: str,
    max_distance: float | None,
    iterations: int,
    tolerance: float,
    start: Pose,
) -> Pose:
    if max_distance is not None and not max_distance > 0:
        raise ValueError(f"max_distance = {max_distance}: expected a length above 0, or None")
    if iterations < 1 or not tolerance > 0:
        raise ValueError(f"iterations = {iterations}, tolerance = {tolerance}: expected at least 1, and above 0")
    T = as_matrix(start)
    moved = small_gicp.align(
        target,
        source,
        init_T_target_source=T,
        registration_type=kind,
        max_correspondence_distance=np.inf if max_distance is None else max_distance,
        num_threads=1,
        max_iterations=iterations,
        rotation_epsilon=tolerance,
        translation_epsilon=tolerance,
    )
    # Without a single pair of points its normal equations are empty, and what it returns is undefined.
    found = None if moved.num_inliers == 0 else as_pose(moved.T_target_source)
    return (T[:3, :3], T[:3, 3]) if found is None else found


def _package() -> str:
    return f"small_gicp {version('small_gicp')}"
