"""MaskNet (Sarode et al., 3DV 2020): which points of the target does the source show? Any method may register what is left of the target.

`masked` makes the pairs for another network. The pose that this network returns is that of a few iterations of point-to-point ICP.
"""

from __future__ import annotations

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import Model
from cmig_jax.models.masknet.flags import MaskNetFlags
from cmig_jax.models.overlap import overlapping
from cmig_jax.nn.mlp import Dense, NormedMLP
from cmig_jax.nn.pointnet import DenseBesidePooled, PointNet
from cmig_jax.ops.neighbours import nearest, top_k
from cmig_jax.ops.procrustes import weighted_procrustes
from cmig_jax.structs import Batch, Correspondences, Prediction
from cmig_jax.transform import RigidTransform


@struct.dataclass
class MaskNetPrediction(Prediction):
    """The pose of ICP, the mask as `target_overlap`, and what was chosen with it.

    Attributes:
        logit: `[B, M]` of the mask.
        chosen: `[B, K]` indices of the target points with the highest scores.
        label: `[B, M]` true mask that was given to the network, or None.
    """

    logit: Array = struct.field(kw_only=True)
    chosen: Array = struct.field(kw_only=True)
    label: Array | None = struct.field(kw_only=True, default=None)


class MaskNet(nn.Module):
    """Scores the points of Y (target) by whether X (source) shows them too."""

    flags: MaskNetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        flags, compute = self.flags, self.compute
        self.encoder = PointNet(flags.widths, compute=compute)
        self.first = DenseBesidePooled(flags.mask_widths[0], compute)
        self.rest = NormedMLP(flags.mask_widths[1:], compute, use_bias=True, norm="none")
        self.last = Dense(1, compute=compute)

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None, label: Array | None = None) -> MaskNetPrediction:
        """Score the target's points, choose among them, and register.

        Args:
            batch: the pairs.
            train: normalise with batch statistics.
            key: not used: nothing is drawn.
            label: `[B, M]` true mask for the loss, instead of the one that `overlap_threshold` gives.
        """
        pooled = self.encoder.pooled(batch.source, train=train)
        features = self.encoder(batch.target, train=train)
        _, logit = self.score(features, pooled)
        mask = nn.sigmoid(logit)
        chosen = top_k(jax.lax.stop_gradient(mask), self.flags.chosen(batch.source.shape[1], batch.target.shape[1]))
        pose, partner = icp(batch.source, _pick(batch.target, chosen), self.flags.icp_iterations)
        B, N, _ = batch.source.shape
        matched = Correspondences(
            source_index=jnp.broadcast_to(jnp.arange(N), (B, N)),
            target_index=chosen,
            partner=partner,
            weight=jnp.full((B, N), 1 / N, batch.source.dtype),
        )
        return MaskNetPrediction(pose, matched, target_overlap=mask, logit=logit, chosen=chosen, label=label)

    def score(self, features: Array, pooled: Array) -> tuple[Array, Array]:
        """Return the last hidden features `[B, M, C]` and the logits `[B, M]` of points, beside the source's `pooled [B, C]`."""
        hidden = self.rest(nn.relu(self.first(features, pooled)), train=False)
        return hidden, self.last(hidden)[..., 0].astype(features.dtype)


def icp(source: Array, target: Array, iterations: int) -> tuple[RigidTransform, Array]:
    """Register by point-to-point ICP from equal centroids and no rotation, without derivative.

    Args:
        source: `[B, N, 3]`.
        target: `[B, K, 3]`.
        iterations: how often points are matched.

    Returns:
        The poses `[B]`, and the target point `[B, N]` nearest to each moved source point.
    """
    source, target = jax.lax.stop_gradient((source, target))
    B, N, _ = source.shape
    weight = jnp.full((B, N), 1 / N, source.dtype)

    def step(_: Array, last: tuple[RigidTransform, Array]) -> tuple[RigidTransform, Array]:
        pose = weighted_procrustes(source, _pick(target, last[1]), weight)
        return pose, nearest(pose.apply(source), target)[0]

    identity = RigidTransform.identity((B,), source.dtype)
    start = RigidTransform(R=identity.R, t=jnp.mean(target, axis=1) - jnp.mean(source, axis=1))
    return jax.lax.fori_loop(0, iterations, step, (start, nearest(start.apply(source), target)[0]))


def masked(prediction: MaskNetPrediction, batch: Batch) -> Batch:
    """Return the pairs with the chosen points in place of the target, `[B, K, 3]`, for another network."""
    normals = None if batch.target_normals is None else _pick(batch.target_normals, prediction.chosen)
    return replace(batch, target=_pick(batch.target, prediction.chosen), target_normals=normals)


def true_mask(batch: Batch, threshold: float) -> Array:
    """Return for each target point, `[B, M]`, 1 if a source point is closer than `threshold` under the true pose, else 0."""
    return overlapping(batch, threshold)[1].astype(batch.target.dtype)


def losses(prediction: MaskNetPrediction, batch: Batch, flags: MaskNetFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return `mask`, the error of the mask."""
    label = true_mask(batch, flags.overlap_threshold) if prediction.label is None else prediction.label
    if flags.loss == "bce":
        return {"mask": jnp.mean(optax.sigmoid_binary_cross_entropy(prediction.logit, label))}
    return {"mask": jnp.mean((nn.sigmoid(prediction.logit) - label) ** 2)}


def _pick(points: Array, index: Array) -> Array:
    """Select points of `[B, M, 3]` by `[B, K]`."""
    return jnp.take_along_axis(points, index[..., None], axis=1)


MASKNET = Model(flags=MaskNetFlags, build=MaskNet, losses=losses)
