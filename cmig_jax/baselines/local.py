"""Local methods (Sec. IV-A): the identity, point-to-point ICP and generalised ICP (small_gicp); and the ICP that ends global methods.

Each pair runs on one thread. Lengths are in the clouds' unit; the tuned settings are for objects normalised to the unit sphere.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
import small_gicp
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from cmig_jax.baselines.method import Floats, checked_clouds, no_motion, recorded
from cmig_jax.transform import RigidTransform, valid_transform

TUNED_ROUNDS = (None, 0.1)
"""Cutoff of each round of the tuned ICP, which also follows the global methods."""


def icp(
    source: ArrayLike,
    target: ArrayLike,
    *,
    max_distance: float | None,
    iterations: int = 200,
    tolerance: float = 1e-6,
    start: RigidTransform | None = None,
) -> RigidTransform:
    """Register by point-to-point ICP (small_gicp).

    Args:
        source: `[N, 3]` points.
        target: `[M, 3]` points.
        max_distance: pairs of points farther apart than this are ignored, in the clouds' unit; None ignores none.
        iterations: largest number of iterations.
        tolerance: stop when a step turns by less than this (radians) and moves by less than this.
        start: initial target_from_source; the identity by default.

    Returns:
        target_from_source, NumPy float64; the start if no pair of points is closer than `max_distance`.

    Raises:
        ValueError: a cloud with fewer than 3 points, another shape, or coordinates that are not finite; a setting out of range.
    """
    source, target = checked_clouds(source, target)
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
    start: RigidTransform | None = None,
) -> RigidTransform:
    """Register by generalised ICP (small_gicp): every point has a covariance, so that planes slide on planes.

    It is more precise than ICP on clouds that were sampled independently, which share a surface but no points, if they are so dense that
    the neighbours of a point lie on its plane: on objects of 384 points, but not on all of 192. Arguments, result and errors are those
    of `icp`; `neighbours` is the number of points per covariance (20 in the documentation of small_gicp).
    """
    source, target = checked_clouds(source, target)
    clouds = _with_covariances(source, neighbours), _with_covariances(target, neighbours)
    return _align(*clouds, "GICP", max_distance, iterations, tolerance, no_motion() if start is None else start)


@dataclass(frozen=True)
class Identity:
    """The pose that moves nothing; its errors are those without registration."""

    def register(self, source: ArrayLike, target: ArrayLike) -> RigidTransform:
        """Check the clouds, and return the pose that moves nothing."""
        checked_clouds(source, target)
        return no_motion()

    @property
    def settings(self) -> dict[str, Any]:
        """Nothing to set."""
        return {}


@dataclass(frozen=True)
class Icp:
    """Point-to-point ICP in rounds; each starts from the pose of the round before.

    Attributes:
        max_distances: `max_distance` of each round.
        iterations, tolerance: `iterations` and `tolerance` of every round.
        start_angle_deg: None starts from the identity. A number starts with both clouds' means at the same place and this angle about
            each axis, R = Rx Ry Rz, for example the mean of a protocol (`data.protocol.mean_angle_deg`). The paper's angles are uniform
            in [0, 45] degrees (Sec. IV-B), so the identity is a corner of their range; a network learns their mean from its training
            pairs.
    """

    max_distances: tuple[float | None, ...] = TUNED_ROUNDS
    iterations: int = 200
    tolerance: float = 1e-6
    start_angle_deg: float | None = None

    def register(self, source: ArrayLike, target: ArrayLike) -> RigidTransform:
        """Register one pair."""
        source, target = checked_clouds(source, target)
        start = no_motion()
        if self.start_angle_deg is not None:
            R = Rotation.from_euler("zyx", [self.start_angle_deg] * 3, degrees=True).as_matrix()
            start = RigidTransform(R=R, t=target.mean(axis=0) - R @ source.mean(axis=0))
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
    start: RigidTransform,
    iterations: int = 200,
    tolerance: float = 1e-6,
) -> RigidTransform:
    """Register by `icp` once per cutoff, each time from the pose before."""
    for max_distance in max_distances:
        start = icp(source, target, max_distance=max_distance, iterations=iterations, tolerance=tolerance, start=start)
    return start


class GlobalMethod(abc.ABC):
    """A method that searches for a pose without a start, then refines it by ICP; its subclasses search."""

    refinement: tuple[float | None, ...]

    def register(self, source: ArrayLike, target: ArrayLike) -> RigidTransform:
        """Register one pair; where no pose is found, the refinement starts from the identity."""
        source, target = checked_clouds(source, target)
        return icp_rounds(source, target, self.refinement, self._search(source, target) or no_motion())

    @abc.abstractmethod
    def _search(self, source: Floats, target: Floats) -> RigidTransform | None:
        """Return a pose, or None if none is found."""


ICP_CUTOFF = Icp(max_distances=(0.02,), iterations=30)
"""ICP with the settings of many comparisons: pairs of points farther apart than 0.02 are ignored, 30 iterations. From the identity, the
paper's pairs have almost no points that close, so the pose stays at the start; `ICP_TUNED` is the fair row."""
ICP_TUNED = Icp()
"""ICP with tuned settings: without a cutoff until it converges, then with a cutoff of 0.1, which drops the points that the crop left
without a correspondent. Chosen among twelve schedules on 300 training objects of the second half of the categories (1,024 points
cropped to 768, noise 0.01, Sec. IV-B); RMSE(R) / MAE(R) / recall, and time per pair:

===============================  ====================  ======
0.02 (`ICP_CUTOFF`)              26.1 / 22.2 / 0.00    1.0 ms
none, 20 iterations, 1e-3        11.2 / 5.45 / 0.43    3.2 ms
none, 500 iterations             9.01 / 2.31 / 0.87    6.0 ms
0.5                              9.77 / 2.45 / 0.87    6.2 ms
0.1                              23.3 / 13.1 / 0.40    9.6 ms
**none, then 0.1**               9.28 / 1.98 / 0.90    6.8 ms
none, 0.3, 0.1                   9.28 / 1.97 / 0.90    6.8 ms
none, 0.5, 0.2, 0.1, 0.05        11.1 / 2.14 / 0.90    7.7 ms
===============================  ====================  ======

With independent crops: 15.9 / 6.79 / 0.49, and 16.4 / 8.32 / 0.38 without the second round.
"""


@dataclass(frozen=True)
class Gicp:
    """Generalised ICP, `gicp`, from the identity.

    It is a method for fine registration and needs a start; like ICP it starts from the identity here. Clouds this small are not
    thinned, and the rounds are those of `ICP_TUNED`.

    Attributes:
        neighbours: points per covariance.
        max_distances: `max_distance` of each round.
        iterations, tolerance: `iterations` and `tolerance` of every round.
    """

    neighbours: int = 20
    max_distances: tuple[float | None, ...] = TUNED_ROUNDS
    iterations: int = 200
    tolerance: float = 1e-6

    def register(self, source: ArrayLike, target: ArrayLike) -> RigidTransform:
        """Register one pair; a round that finds no pose keeps the pose that it started from."""
        source, target = checked_clouds(source, target)
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
    if neighbours < 3:  # with 0 neighbours small_gicp aborts the process
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
    start: RigidTransform,
) -> RigidTransform:
    if max_distance is not None and not max_distance > 0:
        raise ValueError(f"max_distance = {max_distance}: expected a length above 0, or None")
    if iterations < 1 or not tolerance > 0:
        raise ValueError(f"iterations = {iterations}, tolerance = {tolerance}: expected at least 1, and above 0")
    T = np.asarray(start.as_matrix(), np.float64)
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
    # Without any pair of points the normal equations are empty, and the returned pose is undefined.
    found = None if moved.num_inliers == 0 else valid_transform(moved.T_target_source[:3, :3], moved.T_target_source[:3, 3])
    return RigidTransform.from_matrix(T) if found is None else found


def _package() -> str:
    return f"small_gicp {version('small_gicp')}"
