"""Global methods on FPFH features (Open3D, extra `[baselines]`): RANSAC, and Fast Global Registration.

They need no start: the features of both clouds are matched, and a pose is sought that many matches agree with. Nothing tells them that
rotations are small here, so where they are wrong they may be wrong by any angle, and RMSE(R) can exceed the identity's.

Lengths are chosen on 100 training pairs each of generated objects (192 points) and real ones (384 points), sampled once and twice, noise
0.01; the tables have RMSE(R) / MAE(R) / recall, with the finish. The other ratios are those of Open3D's tutorials.

One pair runs on one thread, from a fixed seed. Open3D's limit of threads and its random generator belong to the whole process: the
limit is put back afterwards, the generator is not.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from cmig_jax.baselines.local import TUNED_ROUNDS, icp_rounds
from cmig_jax.baselines.method import Floats, Pose, as_pose, checked_cloud, no_motion, recorded


def load_open3d() -> Any:
    """Import Open3D.

    Raises:
        ImportError: it is not installed, or one of the system's libraries that it needs is not.
    """
    import open3d  # pyright: ignore[reportMissingImports]

    return open3d


@dataclass(frozen=True)
class FpfhRansac:
    """FPFH features, RANSAC over their mutual matches, then ICP.

    ======  ==================  ==================  ==================  ==================
    length  generated, once     generated, twice    real, once          real, twice
    ======  ==================  ==================  ==================  ==================
    0.075   10.3 / 0.90 / 0.99  58.4 / 29.2 / 0.46  10.3 / 0.90 / 0.99  54.2 / 23.9 / 0.65
    0.1     1.2 / 0.33 / 0.99   47.1 / 19.4 / 0.50  0.2 / 0.16 / 1.00   49.8 / 20.8 / 0.65
    0.125   11.0 / 1.12 / 0.99  45.7 / 18.6 / 0.48  0.3 / 0.18 / 1.00   54.9 / 24.7 / 0.62
    ======  ==================  ==================  ==================  ==================

    Attributes:
        length: base length that the others are multiples of, in the clouds' unit.
        normal_radius, feature_radius, max_distance: of a normal, of a feature, between points that agree; in base lengths.
        normal_neighbours, feature_neighbours: at most this many points of each radius.
        mutual: whether two points match only if each is the other's nearest.
        sample: matches per trial.
        edge_similarity: least ratio of corresponding edges in a trial.
        iterations, confidence: trials at most, and the probability at which they may end sooner.
        seed: of the trials.
        finish: rounds of ICP, as `Icp` has them.
    """

    length: float = 0.1
    normal_radius: float = 2.0
    normal_neighbours: int = 30
    feature_radius: float = 5.0
    feature_neighbours: int = 100
    max_distance: float = 1.5
    mutual: bool = True
    sample: int = 3
    edge_similarity: float = 0.9
    iterations: int = 100_000
    confidence: float = 0.999
    seed: int = 0
    finish: tuple[float | None, ...] = TUNED_ROUNDS

    def register(self, source: ArrayLike, target: ArrayLike) -> Pose:
        """Register one pair; where no pose is found, the finish starts from the identity."""
        source, target = checked_cloud(source, "source"), checked_cloud(target, "target")
        return icp_rounds(source, target, self.finish, self._search(source, target) or no_motion())

    @property
    def settings(self) -> dict[str, Any]:
        """The package, what is fixed, and the fields."""
        return _recorded(self)

    def _search(self, source: Floats, target: Floats) -> Pose | None:
        open3d = load_open3d()
        registration = open3d.pipelines.registration
        reach = self.max_distance * self.length
        with _quiet_single_thread(open3d, self.seed):
            found = registration.registration_ransac_based_on_feature_matching(
                *_features(open3d, self, source, target),
                self.mutual,
                reach,
                registration.TransformationEstimationPointToPoint(False),
                self.sample,
                [
                    registration.CorrespondenceCheckerBasedOnEdgeLength(self.edge_similarity),
                    registration.CorrespondenceCheckerBasedOnDistance(reach),
                ],
                registration.RANSACConvergenceCriteria(self.iterations, self.confidence),
            )
        return as_pose(found.transformation) if found.fitness > 0 else None


@dataclass(frozen=True)
class FastGlobal:
    """FPFH features, Fast Global Registration, then ICP.

    ======  ==================  ==================  ==================  ==================
    length  generated, once     generated, twice    real, once          real, twice
    ======  ==================  ==================  ==================  ==================
    0.1     0.3 / 0.24 / 1.00   29.4 / 10.9 / 0.54  0.2 / 0.16 / 1.00   36.2 / 12.9 / 0.67
    0.125   0.3 / 0.24 / 1.00   27.8 / 9.68 / 0.52  0.2 / 0.16 / 1.00   37.8 / 14.0 / 0.66
    0.15    0.3 / 0.24 / 1.00   24.5 / 8.19 / 0.55  0.2 / 0.16 / 1.00   35.6 / 12.8 / 0.69
    0.2     11.3 / 1.27 / 0.99  23.1 / 7.51 / 0.60  0.2 / 0.16 / 1.00   33.6 / 11.8 / 0.69
    ======  ==================  ==================  ==================  ==================

    Attributes:
        length: base length that the others are multiples of, in the clouds' unit.
        normal_radius, feature_radius, max_distance: of a normal, of a feature, between matches that agree; in base lengths.
        normal_neighbours, feature_neighbours: at most this many points of each radius.
        iterations: of the optimisation.
        annealed, division_factor: whether the scale of the robust cost shrinks, down to `max_distance`, and by how much at a time.
        tuple_scale, tuples: similarity of three matches' edges, and how many such threes at most.
        seed: of the choice of threes.
        finish: rounds of ICP, as `Icp` has them.
    """

    length: float = 0.15
    normal_radius: float = 2.0
    normal_neighbours: int = 30
    feature_radius: float = 5.0
    feature_neighbours: int = 100
    max_distance: float = 0.5
    iterations: int = 64
    annealed: bool = True
    division_factor: float = 1.4
    tuple_scale: float = 0.95
    tuples: int = 1000
    seed: int = 0
    finish: tuple[float | None, ...] = TUNED_ROUNDS

    def register(self, source: ArrayLike, target: ArrayLike) -> Pose:
        """Register one pair; where no pose is found, the finish starts from the identity."""
        source, target = checked_cloud(source, "source"), checked_cloud(target, "target")
        return icp_rounds(source, target, self.finish, self._search(source, target) or no_motion())

    @property
    def settings(self) -> dict[str, Any]:
        """The package, what is fixed, and the fields."""
        return _recorded(self)

    def _search(self, source: Floats, target: Floats) -> Pose | None:
        open3d = load_open3d()
        registration = open3d.pipelines.registration
        option = registration.FastGlobalRegistrationOption(
            division_factor=self.division_factor,
            decrease_mu=self.annealed,
            maximum_correspondence_distance=self.max_distance * self.length,
            iteration_number=self.iterations,
            tuple_scale=self.tuple_scale,
            maximum_tuple_count=self.tuples,
        )
        with _quiet_single_thread(open3d, self.seed):
            features = _features(open3d, self, source, target)
            try:
                found = registration.registration_fgr_based_on_feature_matching(*features, option)
            except RuntimeError:  # it refuses clouds without extent
                return None
        return as_pose(found.transformation)


@contextlib.contextmanager
def _quiet_single_thread(open3d: Any, seed: int) -> Iterator[None]:
    """Run Open3D on one thread, whose random numbers alone are the same every time, and without its remarks on single pairs."""
    threads = open3d.utility.get_max_threads()
    open3d.utility.set_max_threads(1)
    open3d.utility.random.seed(seed)
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            yield
    finally:
        open3d.utility.set_max_threads(threads)


def _features(open3d: Any, method: FpfhRansac | FastGlobal, source: Floats, target: Floats) -> tuple[Any, Any, Any, Any]:
    """Return both clouds with their normals, then the features of both."""
    near = open3d.geometry.KDTreeSearchParamHybrid(method.normal_radius * method.length, method.normal_neighbours)
    wide = open3d.geometry.KDTreeSearchParamHybrid(method.feature_radius * method.length, method.feature_neighbours)
    clouds = []
    for points in (source, target):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.estimate_normals(near)
        cloud.orient_normals_towards_camera_location(points.mean(axis=0))
        clouds.append(cloud)
    features = [open3d.pipelines.registration.compute_fpfh_feature(cloud, wide) for cloud in clouds]
    return clouds[0], clouds[1], features[0], features[1]


def _recorded(method: FpfhRansac | FastGlobal) -> dict[str, Any]:
    package = f"open3d {load_open3d().__version__}"
    return recorded(method, package, start="none", thinning="none", normals="towards the centroid", threads=1)
