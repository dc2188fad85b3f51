"""The shape legend, and what passes between a network and the rest of the package.

Shapes: B pairs, N / M points of source / target, K keypoints, k neighbours, C channels, S view sets, V views, H W pixels, n iterations.
Channels last. Lengths in units of the normalised object, angles in radians. A transform says its frames: `target_from_source` takes
source coordinates to target coordinates, `x_target = R x_source + t`.
"""

from __future__ import annotations

from flax import struct
from jax import Array

from cmig_jax.transform import RigidTransform


@struct.dataclass
class Batch:
    """What a network reads.

    Attributes:
        source: `[B, N, 3]` points of X.
        target: `[B, M, 3]` points of Y.
        views: `[B, S, V, H, W, 1]` uint8 depth, 0 = background; `[B, S, V, H, W, 3]` float, normalised RGB; or `[B, S, V, C]`, the
            features of the views, computed elsewhere. S = 1: one set for both clouds; S = 2: source, target. None without images.
        target_from_source: `[B]` the true poses; needed for training, None for inference.
        source_normals: `[B, N, 3]` unit normals of the source's points, or None without normals.
        target_normals: `[B, M, 3]` of the target's.
    """

    source: Array
    target: Array
    views: Array | None = None
    target_from_source: RigidTransform | None = None
    source_normals: Array | None = None
    target_normals: Array | None = None


@struct.dataclass
class Correspondences:
    """Which points a network has matched.

    Attributes:
        source_index: `[B, K]` keypoints of the source, indices into its points.
        target_index: `[B, L]` keypoints of the target, indices into its points.
        partner: `[B, K]` position among the target keypoints of each source keypoint's partner.
        weight: `[B, K]` weight of each correspondence in the pose, 0 or more; 0 is not used.
    """

    source_index: Array
    target_index: Array
    partner: Array
    weight: Array


@struct.dataclass
class Prediction:
    """What every network returns; a network's own outputs are fields of its subclass.

    Attributes:
        target_from_source: `[B]` the estimated poses.
        correspondences: of the last iteration, or None for a network that matches no points.
        source_overlap: `[B, N]` score in [0, 1] of each source point having a correspondent in the target, or None.
        target_overlap: `[B, M]` of the target's points.
    """

    target_from_source: RigidTransform
    correspondences: Correspondences | None = None
    source_overlap: Array | None = None
    target_overlap: Array | None = None
