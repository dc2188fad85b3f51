"""From a matching of keypoints to correspondences, their weights and a pose (Sec. III-E)."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import Kernels
from cmig_jax.geometry.sinkhorn import log_sinkhorn_with_slack
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.models.cmignet.heads import KeypointSet, Match
from cmig_jax.models.cmignet.prediction import Iteration, Keypoints
from cmig_jax.ops.procrustes import weighted_procrustes
from cmig_jax.structs import Correspondences

HIGHEST = jax.lax.Precision.HIGHEST
SINKHORN_ROUNDS = 5  # RPM-Net's
MATCH_LIMIT = 20.0  # |M| beyond which the reference clips, so that no softmax saturates


def solve(match: Match, source: KeypointSet, target: KeypointSet, flags: CMIGNetFlags, kernels: Kernels) -> Iteration:
    """Turn a matching into correspondences, weights (Eq. 10) and a pose (Eq. 11).

    Args:
        match: similarities of the keypoints.
        source, target: the keypoints, the source's as the iterations before have moved them.
        flags: those of matching and pose.
        kernels: of the weighted SVD.
    """
    total = match.feature if match.coordinate is None else match.feature + match.coordinate
    total = jnp.clip(total, -MATCH_LIMIT, MATCH_LIMIT)
    correspondence = jnp.argmax(total, axis=-1)
    score, log_matching, log_slack = nn.sigmoid(match.logit), None, None
    if flags.matching.correspondence == "hard":
        corresponding = jnp.take_along_axis(target.points, correspondence[..., None], axis=1)
    elif flags.matching.correspondence == "soft":
        corresponding = jnp.matmul(nn.softmax(total, axis=-1), target.points, precision=HIGHEST)
    else:
        log_matching, log_slack = log_sinkhorn_with_slack(total, SINKHORN_ROUNDS)
        correspondence = jnp.argmax(log_matching, axis=-1)
        corresponding = jnp.matmul(nn.softmax(log_matching, axis=-1), target.points, precision=HIGHEST)
        score *= jnp.sum(jnp.exp(log_matching), axis=-1)
    if source.overlap is not None:
        score *= source.overlap
    weight = credible_half(score)
    step = weighted_procrustes(source.points, corresponding, weight, flags.pose.centroid, kernels)
    if flags.pose.gradient == "stopped":
        step = jax.lax.stop_gradient(step)
    return Iteration(
        source=source.points,
        step=step,
        feature_match=match.feature,
        coordinate_match=match.coordinate,
        match=total,
        log_matching=log_matching,
        log_slack=log_slack,
        logit=match.logit,
        weight=weight,
        correspondence=correspondence,
        corresponding=corresponding,
    )


def credible_half(score: Array) -> Array:
    """Turn scores `[B, K]` into weights that sum to 1, 0 below the lower of the medians (Eq. 10)."""
    K = score.shape[-1]
    median = jnp.sort(jax.lax.stop_gradient(score), axis=-1)[..., (K - 1) // 2, None]
    weight = jnp.where(score >= median, score, 0)
    return weight / (jnp.sum(weight, axis=-1, keepdims=True) + 1e-8)


def final_correspondences(keypoints: Keypoints, last: Iteration) -> Correspondences | None:
    """Return the correspondences of the last iteration; None of a regressed pose, which has none."""
    if last.correspondence is None or last.weight is None:
        return None
    return Correspondences(keypoints.source_index, keypoints.target_index, last.correspondence, last.weight)
