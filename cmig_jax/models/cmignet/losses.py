"""The five losses (Sec. III-B and III-F). They read a prediction and the batch, never parameters."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
import optax
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import squared_distances
from cmig_jax.models.cmignet.flags import CMIGNetFlags, LossFlags
from cmig_jax.models.cmignet.prediction import CMIGNetPrediction, Iteration, MatchingPrediction
from cmig_jax.models.overlap import overlapping
from cmig_jax.ops.chunks import chunk_length, split
from cmig_jax.ops.pooling import maximum
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

T = TypeVar("T")


def losses(prediction: CMIGNetPrediction, batch: Batch, flags: CMIGNetFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Compute every loss term that applies; their plain sum is the total (Eq. 15).

    Args:
        prediction: of a training pass.
        batch: with the true pose.
        flags: those of the losses.
        compute: `kernels`, and `rows`, the rows of a distance matrix per chunk.

    Returns:
        Scalars: `cross_modal`, `overlap`, `mask`, then `matching_<i>` and `credibility_<i>` per iteration (the pcrnet head, which has
        no correspondences, has `pose_<i>` instead).
    """
    loss, pose = flags.loss, _present(batch.target_from_source)
    terms = {}
    if loss.cross_modal != "off":
        terms["cross_modal"] = _cross_modal(prediction, loss, compute)
    if loss.overlap:
        terms["overlap"] = _overlap(prediction, batch, loss, compute.rows)
    if prediction.source_scores is not None and prediction.iterations[0].match is not None:
        terms["mask"] = partners(prediction, batch, loss, compute.rows) if flags.keypoints.target == "overlap" else mask(prediction)
    for i, iteration in enumerate(prediction.iterations):
        if iteration.match is None:
            terms[f"pose_{i}"] = _pose(iteration, prediction, batch)
        else:
            terms[f"matching_{i}"] = matching(prediction, iteration, loss)
            terms[f"credibility_{i}"] = credibility(prediction, iteration, batch.source, pose, loss)
    return terms


def cross_modal(points: Array, images: Array, temperature: float, include_positive: bool) -> Array:
    """Contrast cloud vectors with image vectors over the batch (Eq. 3-6).

    Args:
        points: `[B, C]` mean of the two clouds' pooled features.
        images: `[B, C]`.
        temperature: tau.
        include_positive: whether the positive stands in the denominator (NT-Xent) or not (Eq. 4, which can go below 0).
    """
    vectors = jnp.concatenate([points, images])
    square = jnp.sum(vectors**2, axis=-1, keepdims=True)
    vectors = vectors / jnp.sqrt(jnp.where(square == 0, 1, square))  # a zero vector stays zero; the root has no derivative there
    similarity = jnp.matmul(vectors, vectors.T, precision=jax.lax.Precision.HIGHEST) / temperature
    B = points.shape[0]
    partner = jnp.roll(jnp.arange(2 * B), B)
    positive = jnp.take_along_axis(similarity, partner[:, None], axis=1)[:, 0]
    left_out = jnp.eye(2 * B, dtype=bool)
    if not include_positive:
        left_out |= jnp.roll(left_out, B, axis=1)
    return jnp.mean(jax.nn.logsumexp(similarity, axis=1, where=~left_out) - positive)


def overlap(
    f: Array, g: Array, overlaps_x: Array, overlaps_y: Array, margins: tuple[float, float], active_mean: bool, rows: int = 0
) -> Array:
    """Pull overlapping features together and push others away, for one pair (Eq. 2).

    Args:
        f, g: `[N, C]`, `[M, C]` point features.
        overlaps_x, overlaps_y: `[N]`, `[M]` whether a point overlaps the other cloud.
        margins: sigma_p, sigma_n.
        active_mean: divide each sum by the pairs with a non-zero term instead of all pairs of its set.
        rows: points of the first cloud per chunk; 0: all at once.
    """

    def sums(total: Array, chunk: tuple[Array, Array, Array]) -> tuple[Array, None]:
        """Add the sum and the number of terms of each of the three sets of pairs, `[3, 2]`."""
        f, overlaps, valid = chunk
        distance = jnp.sqrt(squared_distances(f, g) + 1e-7)
        positive, negative = jax.nn.relu(distance - margins[0]) ** 2, jax.nn.relu(margins[1] - distance) ** 2
        x, y, valid = overlaps[:, None], overlaps_y[None, :], valid[:, None]
        found = []
        for term, members in ((positive, x & y), (negative, x & ~y), (negative, ~x & y)):
            members = members & valid
            counted = members & (term > 0) if active_mean else members
            found.append(jnp.stack([jnp.sum(jnp.where(members, term, 0)), jnp.sum(counted).astype(term.dtype)]))
        return total + jnp.stack(found), None

    N, start = len(f), jnp.zeros((3, 2), f.dtype)
    whole = (f, overlaps_x, jnp.ones(N, bool))
    if rows == 0 or rows >= N:
        total, _ = sums(start, whole)
    else:
        chunks = tuple(split(x, 0, chunk_length(N, rows)) for x in whole)
        total, _ = jax.lax.scan(jax.checkpoint(sums), start, chunks)
    return jnp.sum(total[:, 0] / jnp.maximum(total[:, 1], 1))


def mask(prediction: MatchingPrediction) -> Array:
    """Regress the scores on the negative entropy of the first matching: rows for the source, columns for the target (Sec. III-F, L_MP)."""
    match, chosen = _present(prediction.iterations[0].match), prediction.keypoints
    sides = ((_present(prediction.source_scores), chosen.source_index, -1), (_present(prediction.target_scores), chosen.target_index, -2))
    total = jnp.zeros((), match.dtype)
    for scores, index, axis in sides:
        log_p = jax.nn.log_softmax(jax.lax.stop_gradient(match), axis=axis)
        negative_entropy = jnp.sum(jnp.exp(log_p) * log_p, axis=axis)
        total += 0.5 * jnp.mean((jnp.take_along_axis(scores, index, axis=1) - negative_entropy) ** 2)
    return total


def partners(prediction: CMIGNetPrediction, batch: Batch, flags: LossFlags, rows: int = 0) -> Array:
    """Return the binary cross entropy of the scores of all points as logits of having a partner within `match_threshold`."""
    scores = _present(prediction.source_scores), _present(prediction.target_scores)
    labels = overlapping(batch, flags.match_threshold, rows)
    entropies = [jnp.mean(optax.sigmoid_binary_cross_entropy(s, label.astype(s.dtype))) for s, label in zip(scores, labels, strict=True)]
    return 0.5 * (entropies[0] + entropies[1])


def matching(prediction: MatchingPrediction, iteration: Iteration, flags: LossFlags) -> Array:
    """Return the negative log-likelihood of the true correspondents under the matching matrix (L_CS).

    With Sinkhorn's matching it is the mean over all keypoints, of those without a correspondent under the slack.
    """
    index, label = _present(prediction.keypoints.match_index), _present(prediction.keypoints.match_label)
    if iteration.log_matching is not None:
        chosen = jnp.take_along_axis(iteration.log_matching, index[..., None], axis=-1)[..., 0]
        return -jnp.mean(jnp.where(label > 0, chosen, _present(iteration.log_slack)))
    log_p = jax.nn.log_softmax(_present(iteration.match), axis=-1)
    chosen = jnp.take_along_axis(log_p, index[..., None], axis=-1)[..., 0]
    count = jnp.maximum(jnp.sum(label), 1) if flags.match_mean == "positive" else label.size
    return -jnp.sum(label * chosen) / count


def credibility(prediction: MatchingPrediction, iteration: Iteration, source: Array, pose: RigidTransform, flags: LossFlags) -> Array:
    """Return the binary cross entropy of the matching scores (L_MS).

    Args:
        prediction: for the keypoints.
        iteration: whose scores.
        source: `[B, N, 3]` the source cloud as given.
        pose: true target_from_source.
        flags: `credibility_label`, `match_threshold`.
    """
    chosen, logit = prediction.keypoints, _present(iteration.logit)
    if flags.credibility_label == "index":
        right = _present(iteration.correspondence) == chosen.match_index
    else:
        keypoints = jnp.take_along_axis(source, chosen.source_index[..., None], axis=1)
        offset = pose.apply(keypoints) - _present(iteration.corresponding)
        right = jnp.sum(offset**2, axis=-1) < flags.match_threshold**2
    return jnp.mean(optax.sigmoid_binary_cross_entropy(logit, right.astype(logit.dtype)))


def _present(value: T | None) -> T:
    assert value is not None, "this loss needs an output that a training pass with this head has"
    return value


def _cross_modal(prediction: CMIGNetPrediction, flags: LossFlags, compute: ComputeConfig) -> Array:
    pooled = [maximum(x, 1, compute.kernels) for x in (prediction.source_features, prediction.target_features)]
    points = 0.5 * (pooled[0] + pooled[1])
    images = jnp.mean(_present(prediction.image_features), axis=1).astype(points.dtype)
    return cross_modal(points, images, flags.temperature, include_positive=flags.cross_modal == "nt-xent")


def _overlap(prediction: CMIGNetPrediction, batch: Batch, flags: LossFlags, rows: int) -> Array:
    overlaps_x, overlaps_y = overlapping(batch, flags.overlap_threshold, rows)
    active = flags.overlap_mean == "active"
    per_pair = jax.vmap(lambda f, g, x, y: overlap(f, g, x, y, flags.margins, active, rows))
    return jnp.mean(per_pair(prediction.source_features, prediction.target_features, overlaps_x, overlaps_y))


def _pose(iteration: Iteration, prediction: CMIGNetPrediction, batch: Batch) -> Array:
    """Return the mean distance between the keypoints under this iteration's pose and under the true one."""
    keypoints = jnp.take_along_axis(batch.source, prediction.keypoints.source_index[..., None], axis=1)
    offset = iteration.step.apply(iteration.source) - _present(batch.target_from_source).apply(keypoints)
    return jnp.mean(jnp.sqrt(jnp.sum(offset**2, axis=-1) + 1e-12))
