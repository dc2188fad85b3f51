"""What `register` returns: the pose, whether it can be trusted, and what speaks for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmig_jax.transform import RigidTransform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Registration:
    """The pose that aligns two clouds, and how far it can be trusted. Lengths are in the unit of the clouds.

    Attributes:
        target_from_source: the pose, NumPy float64.
        trusted: whether `confidence` is at least `verdict.TRUSTED`.
        why: one sentence on `trusted`.
        confidence: estimated probability that the pose is right (within 5 degrees and 0.05 of the clouds' radius), in [0, 1].
        overlap: shares of the source's and of the target's surface that have a partner in the other cloud.
        inlier_rmse: root mean square distance of those partners.
        correspondences: `[n, 2]`, positions of partners in the source and in the target that were given.
        information: `[6, 6]`, the Hessian of the last refinement with respect to (rotation vector, translation), in the normalised frame
            of both clouds (each at its own centre, radius 1).
        alternatives: other poses that fit almost as well, at most eight, best first.
        dropped: rows of the source and of the target that were left out because they are not finite.
        seconds: time by stage.
    """

    target_from_source: RigidTransform
    trusted: bool
    why: str
    confidence: float
    overlap: tuple[float, float]
    inlier_rmse: float
    correspondences: NDArray[np.int64]
    information: Floats
    alternatives: tuple[RigidTransform, ...]
    dropped: tuple[int, int]
    seconds: Mapping[str, float]

    @property
    def matrix(self) -> Floats:
        """The pose as a 4 x 4 matrix, for column vectors, as trimesh, Open3D and ROS take it."""
        return np.asarray(self.target_from_source.as_matrix())

    def apply(self, points: ArrayLike) -> Floats:
        """Move points `[..., N, 3]` of the source's frame into the target's."""
        return np.asarray(self.target_from_source.apply(np.asarray(points, np.float64)))

    def __str__(self) -> str:
        """Describe the result in a few lines."""
        rows = "\n".join("  ".join(f"{number:14.8g}" for number in row) for row in self.matrix)
        source, target = (f"{100 * share:.0f} %" for share in self.overlap)
        lines = [
            f"{'trusted' if self.trusted else 'NOT trusted'} (confidence {self.confidence:.2f}): {self.why}",
            f"target_from_source, a rotation by {np.degrees(self.target_from_source.angle()):.2f} degrees:",
            rows,
            f"overlap: {source} of the source, {target} of the target; inlier RMSE {self.inlier_rmse:.4g}",
        ]
        if self.alternatives:
            lines.append(f"{len(self.alternatives)} other pose(s) fit almost as well")
        return "\n".join(lines)
