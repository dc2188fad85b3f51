"""KISS-Matcher (extra `[baselines]`): Faster-PFH features, pruning of matches by a k-core, graduated non-convexity; then ICP.

The settings were chosen on 100 training pairs each of generated objects (192 points) and real ones (384 points), sampled once and
twice, noise 0.01; RMSE(R) / MAE(R) / recall:

=====================  ==================  ==================  ==================  ==================
length, normals        generated, once     generated, twice    real, once          real, twice
=====================  ==================  ==================  ==================  ==================
0.075, 3.0             12.0 / 1.59 / 0.97  52.8 / 26.8 / 0.39  0.24 / 0.16 / 1.00  54.5 / 25.9 / 0.50
0.1, 2.5               11.3 / 1.35 / 0.97  60.1 / 31.2 / 0.41  13.6 / 1.65 / 0.98  58.3 / 29.3 / 0.52
0.1, 3.0               21.6 / 3.86 / 0.96  52.7 / 25.1 / 0.36  10.3 / 0.90 / 0.99  51.7 / 23.7 / 0.55
0.125, 3.0             19.7 / 3.28 / 0.96  54.0 / 26.6 / 0.31  19.6 / 2.94 / 0.95  51.7 / 22.9 / 0.56
0.15, 3.0              23.0 / 4.19 / 0.95  47.7 / 20.9 / 0.44  21.0 / 3.76 / 0.94  46.1 / 19.6 / 0.59
0.1, 3.0, no refinement    20.7 / 6.24 / 0.65  54.8 / 37.1 / 0.00  11.2 / 2.56 / 0.80  53.7 / 34.6 / 0.01
=====================  ==================  ==================  ==================  ==================

The rows differ by single pairs with large errors; the length is one from the middle of the range.

The package has no setting for threads: it uses all cores of the process (`taskset -c 0` limits it to one), and the pose does not depend
on their number.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from cmig_jax.baselines.local import TUNED_ROUNDS, GlobalMethod
from cmig_jax.baselines.method import Floats, recorded
from cmig_jax.transform import RigidTransform, valid_transform

FEWEST_NEIGHBOURS = 3
"""Points, itself included, that the package needs within the radius of a normal."""


def load_kiss_matcher() -> Any:
    """Import KISS-Matcher.

    Raises:
        ImportError: it is not installed.
    """
    import kiss_matcher  # pyright: ignore[reportMissingImports]

    return kiss_matcher


@dataclass(frozen=True)
class KissMatcher(GlobalMethod):
    """KISS-Matcher, then ICP.

    Attributes:
        length: base length that the others are multiples of (the package's `voxel_size`), in the clouds' unit.
        normal_radius, feature_radius: radii of the neighbourhoods of normals and features, in base lengths.
        prune_bound, solver_bound: largest differences of matches that agree, in pruning and in solving, in base lengths.
        max_linearity: largest linearity of a neighbourhood with a normal; 1 allows all.
        max_matches: largest number of matches.
        refinement: cutoffs of the rounds of ICP that follow.
    """

    length: float = 0.1
    normal_radius: float = 3.0
    feature_radius: float = 5.0
    prune_bound: float = 1.0
    solver_bound: float = 0.75
    max_linearity: float = 1.0
    max_matches: int = 5000
    refinement: tuple[float | None, ...] = TUNED_ROUNDS

    @property
    def settings(self) -> dict[str, Any]:
        """The package with its version, fixed settings, and the fields."""
        package = f"kiss-matcher {version('kiss-matcher')}"
        return recorded(self, package, start="none", thinning="none", normals="towards the centroid", threads="all")

    def _search(self, source: Floats, target: Floats) -> RigidTransform | None:
        """Return the package's pose; None if the package calls it invalid, or if the clouds are too sparse for normals."""
        kiss_matcher = load_kiss_matcher()
        # The package orients normals towards the origin, so both clouds are centred.
        centres = source.mean(axis=0), target.mean(axis=0)
        clouds = [self._with_normals(cloud - centre) for cloud, centre in zip((source, target), centres, strict=True)]
        if min(len(cloud) for cloud in clouds) < FEWEST_NEIGHBOURS:
            return None
        config = kiss_matcher.KISSMatcherConfig(
            voxel_size=self.length,
            use_voxel_sampling=False,
            thr_linearity=self.max_linearity,
            num_max_corr=self.max_matches,
            normal_r_gain=self.normal_radius,
            fpfh_r_gain=self.feature_radius,
            robin_noise_bound_gain=self.prune_bound,
            solver_noise_bound_gain=self.solver_bound,
        )
        found = kiss_matcher.KISSMatcher(config).estimate(*clouds)
        pose = valid_transform(np.asarray(found.rotation, np.float64), np.asarray(found.translation, np.float64)) if found.valid else None
        return None if pose is None else RigidTransform(R=pose.R, t=pose.t + centres[1] - pose.R @ centres[0])

    def _with_normals(self, points: Floats) -> np.ndarray:
        """Keep the points that have a normal, in float32 as the package does; on a cloud without normals the package aborts the process."""
        cloud = points[np.abs(points).max(axis=1) < np.finfo(np.float32).max].astype(np.float32)
        radius = self.normal_radius * self.length * (1 - 1e-4)
        while len(cloud):
            enough = KDTree(cloud).query_ball_point(cloud, radius, return_length=True) >= FEWEST_NEIGHBOURS
            if enough.all():
                break
            cloud = cloud[enough]
        return cloud
