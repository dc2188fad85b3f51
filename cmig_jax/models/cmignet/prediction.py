"""What CMIGNet returns."""

from __future__ import annotations

from flax import struct
from jax import Array

from cmig_jax.structs import Prediction
from cmig_jax.transform import RigidTransform


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
class Iteration:
    """One round of correspondence search and pose (Sec. III-E).

    Attributes:
        source: `[B, K, 3]` source keypoints, moved by the iterations before.
        step: pose found in this iteration, from the moved source to the target.
        feature_match: `[B, K, K]` M_F, rows source keypoints, columns target keypoints (None for the pcrnet head).
        coordinate_match: `[B, K, K]` M_P (None for the idam and pcrnet heads).
        match: `[B, K, K]` matching matrix M before its softmax, clipped (None for pcrnet).
        log_matching: `[B, K, K]` logarithm of the matching by Sinkhorn's normalisation (None for others).
        log_slack: `[B, K]` logarithm of its slack: how much of a source keypoint has no partner (None for others).
        logit: `[B, K]` matching score s before its sigmoid (None for pcrnet).
        weight: `[B, K]` w of Eq. 10, which sum to 1 (None for pcrnet).
        correspondence: `[B, K]` index of the target keypoint matched to each source keypoint (None for pcrnet).
        corresponding: `[B, K, 3]` the matched target keypoints (None for pcrnet).
    """

    source: Array
    step: RigidTransform
    feature_match: Array | None = None
    coordinate_match: Array | None = None
    match: Array | None = None
    log_matching: Array | None = None
    log_slack: Array | None = None
    logit: Array | None = None
    weight: Array | None = None
    correspondence: Array | None = None
    corresponding: Array | None = None


@struct.dataclass(kw_only=True)
class MatchingPrediction(Prediction):
    """What networks return that match keypoints in several rounds; the losses of matching read this.

    Attributes:
        keypoints: the selected points.
        iterations: n rounds of correspondence search.
        source_scores, target_scores: `[B, N]`, `[B, M]` significance of each cloud's points, or None where none is predicted.
    """

    keypoints: Keypoints
    iterations: tuple[Iteration, ...]
    source_scores: Array | None = None
    target_scores: Array | None = None


@struct.dataclass(kw_only=True)
class CMIGNetPrediction(MatchingPrediction):
    """What the network returns; the losses read this, never parameters. It has overlaps with `keypoints.target=overlap` alone.

    Attributes:
        source_features, target_features: `[B, N, C]`, `[B, M, C]` of the point encoder, before fusion (F_X, F_Y).
        image_features: `[B, S, C]` maximum over views (F_I), or None.
        source_fused, target_fused: `[B, N, C]`, `[B, M, C]` hybrid features after fusion (F'_X, F'_Y).
    """

    source_features: Array
    target_features: Array
    source_fused: Array
    target_fused: Array
    image_features: Array | None = None
