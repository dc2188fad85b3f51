"""The shape legend and the containers that pass between rooms.

Shapes: B pairs, N / M points of source / target, K keypoints, k neighbours, C channels, S view sets, V views, H W pixels, n iterations.
Channels last. Lengths in units of the normalised object, angles in radians inside. A transform says its frames:
`target_from_source` takes source coordinates to target coordinates, `x_target = R x_source + t`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array


@struct.dataclass
class RigidTransform:
    """A rotation R `[..., 3, 3]` and a translation t `[..., 3]`; leading axes are batch axes.

    Of NumPy arrays (what `register` returns) the methods make NumPy arrays, in their precision.
    """

    R: Array
    t: Array

    @classmethod
    def identity(cls, batch: tuple[int, ...] = (), dtype: jnp.dtype = jnp.float32) -> RigidTransform:
        """Return the transform that moves nothing."""
        return cls(R=jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*batch, 3, 3)), t=jnp.zeros((*batch, 3), dtype))

    def apply(self, points: Array) -> Array:
        """Move points `[..., P, 3]`."""
        return _product("...ij,...pj->...pi", self.R, points) + self.t[..., None, :]

    def compose(self, first: RigidTransform) -> RigidTransform:
        """Return the transform that applies `first`, then this one: `a_from_b.compose(b_from_c)` is `a_from_c`."""
        R = _product("...ij,...jk->...ik", self.R, first.R)
        return RigidTransform(R=R, t=self.apply(first.t[..., None, :])[..., 0, :])

    def inverse(self) -> RigidTransform:
        """Return the transform that undoes this one."""
        R = self.R.swapaxes(-1, -2)
        return RigidTransform(R=R, t=-_product("...ij,...j->...i", R, self.t))


def _product(subscripts: str, a: Array, b: Array) -> Array:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.einsum(subscripts, a, b)
    return jnp.einsum(subscripts, a, b, precision=jax.lax.Precision.HIGHEST)


@struct.dataclass
class Batch:
    """What the network reads.

    Attributes:
        source: `[B, N, 3]` points of X.
        target: `[B, M, 3]` points of Y.
        views: `[B, S, V, H, W, 1]` uint8 depth, 0 = background, or `[B, S, V, H, W, 3]` float, normalised RGB. S = 1: one set for
            both clouds; S = 2: source, target. None where the network uses no image.
        target_from_source: the true pose; needed for training, None for inference.
    """

    source: Array
    target: Array
    views: Array | None = None
    target_from_source: RigidTransform | None = None


@struct.dataclass
class Iteration:
    """One round of correspondence search and pose (Sec. III-E).

    Attributes:
        feature_match: `[B, K, K]` M_F, rows source keypoints, columns target keypoints (None for the pcrnet head).
        coordinate_match: `[B, K, K]` M_P (None for the idam and pcrnet heads).
        match: `[B, K, K]` matching matrix M before its softmax, clipped (None for pcrnet).
        logit: `[B, K]` matching score s before its sigmoid (None for pcrnet).
        weight: `[B, K]` w of Eq. 10, summing to 1 (None for pcrnet).
        source: `[B, K, 3]` source keypoints, moved by the iterations before.
        correspondence: `[B, K]` index of the target keypoint chosen for each source keypoint (None for pcrnet).
        corresponding: `[B, K, 3]` the chosen target keypoints (None for pcrnet).
        step: pose found in this iteration, from the moved source to the target.
    """

    source: Array
    step: RigidTransform
    feature_match: Array | None = None
    coordinate_match: Array | None = None
    match: Array | None = None
    logit: Array | None = None
    weight: Array | None = None
    correspondence: Array | None = None
    corresponding: Array | None = None


@struct.dataclass
class Keypoints:
    """Selected points (Sec. III-D).

    Attributes:
        source_index, target_index: `[B, K]` into the clouds.
        match_index: `[B, K]` position among the target keypoints of the true correspondent of each source keypoint, the nearest under
            the true pose; None in evaluation.
        match_label: `[B, K]` 1 where that distance is below the threshold, else 0; None in evaluation.
    """

    source_index: Array
    target_index: Array
    match_index: Array | None = None
    match_label: Array | None = None


@struct.dataclass
class Prediction:
    """What the network returns; losses, metrics and reports read this, never parameters.

    Attributes:
        source_features, target_features: `[B, N, C]`, `[B, M, C]` of the point encoder, before fusion (F_X, F_Y).
        image_features: `[B, S, C]` maximum over views (F_I), or None.
        source_fused, target_fused: `[B, N, C]`, `[B, M, C]` hybrid features after fusion (F'_X, F'_Y).
        source_scores, target_scores: `[B, N]`, `[B, M]` significance of each cloud's points, or None where none is predicted.
        keypoints: the selected points.
        iterations: n rounds of correspondence search.
        target_from_source: the pose.
    """

    source_features: Array
    target_features: Array
    source_fused: Array
    target_fused: Array
    keypoints: Keypoints
    iterations: tuple[Iteration, ...]
    target_from_source: RigidTransform
    image_features: Array | None = None
    source_scores: Array | None = None
    target_scores: Array | None = None
