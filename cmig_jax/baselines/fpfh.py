"""Global methods on FPFH features (Open3D, extra `[baselines]`): RANSAC, and Fast Global Registration.

They need no start: they match the features of both clouds and search for a pose that agrees with many matches. They do not use that
rotations are small here: the error of a wrong pose may be any angle, so RMSE(R) can exceed that of the identity.

Lengths were chosen on 100 training pairs each of generated objects (192 points) and real ones (384 points), sampled once and twice,
noise 0.01. The tables have RMSE(R) / MAE(R) / recall, with the refinement. The other ratios are those of Open3D's tutorials.

Each pair runs on one thread, from a fixed seed. Open3D's limit of threads and its random generator belong to the whole process: the
limit is restored afterwards, the state of the generator is not.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from cmig_jax.baselines.local import TUNED_ROUNDS, GlobalMethod
from cmig_jax.baselines.method import Floats, recorded
from cmig_jax.transform import RigidTransform, valid_transform


def load_open3d() -> Any:
    """Import Open3D.

    Raises:
        ImportError: it is not installed, or a system library that it needs is not.
    """
    import open3d  # pyright: ignore[reportMissingImports]

    return open3d


class _OnFeatures(GlobalMethod):
    """What the two methods share."""

    length: float
    normal_radius: float
    normal_neighbours: int
    feature_radius: float
    feature_neighbours: int

    @property
    def settings(self) -> dict[str, Any]:
        """The package with its version, fixed settings, and the fields."""
        package = f"open3d {load_open3d().__version__}"
        return recorded(self, package, start="none", thinning="none", normals="towards the centroid", threads=1)

    def _features(self, open3d: Any, source: Floats, target: Floats) -> tuple[Any, Any, Any, Any]:
        """Return both clouds with their normals, then the features of both."""
        near = open3d.geometry.KDTreeSearchParamHybrid(self.normal_radius * self.length, self.normal_neighbours)
        wide = open3d.geometry.KDTreeSearchParamHybrid(self.feature_radius * self.length, self.feature_neighbours)
        clouds = []
        for points in (source, target):
            cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
            cloud.estimate_normals(near)
            cloud.orient_normals_towards_camera_location(points.mean(axis=0))
            clouds.append(cloud)
        features = [open3d.pipelines.registration.compute_fpfh_feature(cloud, wide) for cloud in clouds]
        return clouds[0], clouds[1], features[0], features[1]


@dataclass(frozen=True)
class FpfhRansac(_OnFeatures):
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
        normal_radius, feature_radius: radii of the neighbourhoods of normals and features, in base lengths.
        max_distance: largest distance of points that agree, in base lengths.
        normal_neighbours, feature_neighbours: largest numbers of points within these radii.
        mutual: whether two points match only if each is the other's nearest.
        sample: matches per trial.
        edge_similarity: smallest ratio of corresponding edges in a trial.
        iterations, confidence: largest number of trials, and the probability of success at which they stop.
        seed: seed of the trials.
        refinement: cutoffs of the rounds of ICP that follow.
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
    refinement: tuple[float | None, ...] = TUNED_ROUNDS

    def _search(self, source: Floats, target: Floats) -> RigidTransform | None:
        open3d = load_open3d()
        registration = open3d.pipelines.registration
        reach = self.max_distance * self.length
        with _quiet_single_thread(open3d, self.seed):
            found = registration.registration_ransac_based_on_feature_matching(
                *self._features(open3d, source, target),
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
        return _pose_of(found) if found.fitness > 0 else None


@dataclass(frozen=True)
class FastGlobal(_OnFeatures):
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
        normal_radius, feature_radius: radii of the neighbourhoods of normals and features, in base lengths.
        max_distance: smallest scale of the robust cost, in base lengths.
        normal_neighbours, feature_neighbours: largest numbers of points within these radii.
        iterations: iterations of the optimisation.
        annealed, division_factor: whether the scale of the robust cost decreases, and the factor of each decrease.
        tuple_scale, tuples: smallest similarity of the edges of three matches, and the largest number of such triples.
        seed: seed of the choice of triples.
        refinement: cutoffs of the rounds of ICP that follow.
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
    refinement: tuple[float | None, ...] = TUNED_ROUNDS

    def _search(self, source: Floats, target: Floats) -> RigidTransform | None:
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
            features = self._features(open3d, source, target)
            try:
                found = registration.registration_fgr_based_on_feature_matching(*features, option)
            except RuntimeError:  # clouds without extent
                return None
        return _pose_of(found)


@contextlib.contextmanager
def _quiet_single_thread(open3d: Any, seed: int) -> Iterator[None]:
    """Run Open3D without its warnings and on one thread, since its random numbers can be repeated on one thread only."""
    threads = open3d.utility.get_max_threads()
    open3d.utility.set_max_threads(1)
    open3d.utility.random.seed(seed)
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            yield
    finally:
        open3d.utility.set_max_threads(threads)


def _pose_of(found: Any) -> RigidTransform | None:
    T = np.asarray(found.transformation, np.float64)
    return valid_transform(T[:3, :3], T[:3, 3])
