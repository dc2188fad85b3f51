"""OMNet (Xu et al., ICCV 2021): overlap masks and a regressed pose.

Read top-down: n times encode, exchange global features, predict overlap masks, regress the pose.
Facts of the authors' PyTorch code that its paper does not show, and that this network follows:
the local features of the fusion are masked too; a point's overlap label depends on the masks of its iteration (`overlap_labels`); the sign
of the quaternion is not matched (`quaternion_sign`). The official code needs clouds of equal size; this one does not.
A cloud whose mask is empty counts as zeros, which can happen with another crop than in training.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import squared_distances
from cmig_jax.geometry.rotations import unit_quaternion
from cmig_jax.models.base import Model
from cmig_jax.models.omnet.flags import OMNetFlags
from cmig_jax.models.regressed_pose import Pair, QuaternionPose, Regression, pose_losses
from cmig_jax.nn.mlp import Dense, NormedMLP
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.nn.pointnet import DenseBesidePooled
from cmig_jax.nn.recompute import call
from cmig_jax.ops.pooling import maximum
from cmig_jax.structs import Batch, Prediction


@struct.dataclass
class Step:
    """One iteration.

    Attributes:
        source: `[B, N, 3]` the source's points as this iteration sees them.
        masks: `[B, N]`, `[B, M]` 1 for the points that it uses, 0 for the others.
        logits: `[B, N, 2]`, `[B, M, 2]` that a point does not overlap, and that it does.
        pose: from the given source to the target, after this iteration.
    """

    source: Array
    masks: Pair
    logits: Pair
    pose: QuaternionPose


@struct.dataclass(kw_only=True)
class OMNetPrediction(Prediction):
    """What the network returns, with its iterations."""

    steps: tuple[Step, ...]


class OMNet(nn.Module):
    """Registers the source onto the target."""

    flags: OMNetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.stages = tuple(Stage(self.flags, self.compute) for _ in range(self.flags.iterations))

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> OMNetPrediction:
        """Predict the pose of each pair; there is nothing to draw, so `key` is not read."""
        source, target = batch.source, batch.target
        masks = jnp.ones_like(source[..., 0]), jnp.ones_like(target[..., 0])
        pose, steps, used = QuaternionPose.identity(source.shape[0], source.dtype), [], masks
        for i, stage in enumerate(self.stages):
            seen = jax.lax.stop_gradient(source)
            logits, step = call(stage, seen, target, used, recompute=self.compute.recompute, train=train)
            pose, source = step.follow(pose, seen)
            steps.append(Step(seen, used, logits, pose))
            used = (overlapping(logits[0]), overlapping(logits[1])) if i + 1 >= self.flags.unmasked else masks
        scores = [nn.softmax(x, axis=-1)[..., 1] for x in steps[-1].logits]
        return OMNetPrediction(target_from_source=pose.transform(), source_overlap=scores[0], target_overlap=scores[1], steps=tuple(steps))


class Stage(nn.Module):
    """One iteration: the layers of the two clouds are the same, with batch statistics of each cloud's own."""

    flags: OMNetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.encoder, self.fusion = Encoder(self.flags, self.compute), Fusion(self.flags, self.compute)
        self.decoder = Decoder(self.flags, self.compute)
        self.regression = Regression(self.flags.regression_widths, 7, self.compute)

    def __call__(self, source: Array, target: Array, masks: Pair, *, train: bool) -> tuple[Pair, QuaternionPose]:
        """Return the logits of both clouds, and the pose from `source` as given to `target`."""
        mask_x, mask_y = masks
        local_x, global_x = self.encoder(source, mask_x, train=train)
        local_y, global_y = self.encoder(target, mask_y, train=train)
        fused_x = self.fusion(local_x, (global_x, global_y), mask_x, train=train)
        fused_y = self.fusion(local_y, (global_y, global_x), mask_y, train=train)
        logits_x, pooled_x = self.decoder(fused_x, mask_x, train=train)
        logits_y, pooled_y = self.decoder(fused_y, mask_y, train=train)
        regressed = self.regression(jnp.concatenate([pooled_x, pooled_y], axis=-1), train=train).astype(source.dtype)
        pose = QuaternionPose(unit_quaternion(regressed[:, :4]), regressed[:, 4:])
        return (logits_x.astype(source.dtype), logits_y.astype(source.dtype)), pose


class Encoder(nn.Module):
    """A PointNet whose early layer is the local and whose maximum is the global feature."""

    flags: OMNetFlags
    compute: ComputeConfig

    @nn.compact
    def __call__(self, points: Array, mask: Array, *, train: bool) -> tuple[Array, Array]:
        """Map `points [B, N, 3]` to local features `[B, N, C]` and a global one `[B, D]`; points whose `mask` is 0 count as zeros."""
        local = NormedMLP(self.flags.local_widths, self.compute, use_bias=True, name="local")(points, train=train)
        deep = NormedMLP(self.flags.global_widths, self.compute, use_bias=True, name="global")(local, train=train)
        return masked(local, mask), maximum(masked(deep, mask), 1, self.compute.kernels)


class Fusion(nn.Module):
    """Layers on the local feature of a point and the global features of both clouds."""

    flags: OMNetFlags
    compute: ComputeConfig

    @nn.compact
    def __call__(self, local: Array, vectors: Pair, mask: Array, *, train: bool) -> Array:
        """Map `local [B, N, C]` and the own and the other cloud's vector `[B, D]` to `[B, N, F]`; masked points count in statistics."""
        first, *rest = self.flags.fusion_widths
        hidden = DenseBesidePooled(first, self.compute, name="first")(local, jnp.concatenate(vectors, axis=-1))
        hidden = nn.relu(BatchNorm(first, self.compute, name="first_norm")(hidden, train=train))
        return masked(NormedMLP(tuple(rest), self.compute, use_bias=True, name="rest")(hidden, train=train), mask)


class Decoder(nn.Module):
    """The mask decoder, and the features for the regression."""

    flags: OMNetFlags
    compute: ComputeConfig

    @nn.compact
    def __call__(self, fused: Array, mask: Array, *, train: bool) -> tuple[Array, Array]:
        """Map `fused [B, N, F]` to two logits of every point, and to the maximum over the points of all layers, `[B, D]`."""
        layers = [fused]
        for i, width in enumerate(self.flags.decoder_widths):
            layers.append(NormedMLP((width,), self.compute, use_bias=True, name=f"block_{i}")(layers[-1], train=train))
        logits = Dense(2, compute=self.compute, name="logits")(layers[-1])
        return logits, jnp.concatenate([maximum(masked(x, mask), 1, self.compute.kernels) for x in layers], axis=-1)


def masked(features: Array, mask: Array) -> Array:
    """Multiply `features [B, N, C]` with `mask [B, N]`; a feature of 0 changes no maximum of features after ReLU."""
    return features * mask[..., None].astype(features.dtype)


def overlapping(logits: Array) -> Array:
    """Return the mask `[B, N]` of `logits [B, N, 2]`: 1 where the second is the larger."""
    return (logits[..., 1] > logits[..., 0]).astype(logits.dtype)


def losses(prediction: OMNetPrediction, batch: Batch, flags: OMNetFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return `overlap_<i>`, `quaternion_<i>` and `translation_<i>` of every iteration."""
    truth = batch.target_from_source
    assert truth is not None
    near = near_pairs(batch, flags.overlap_threshold)
    terms = {}
    for i, step in enumerate(prediction.steps):
        both = zip(step.logits, overlap_labels(near, step.masks), strict=True)
        terms[f"overlap_{i}"] = sum(_cross_entropy(logits, label, flags.class_weights) for logits, label in both) / 2
        terms |= pose_losses(i, step.pose, truth, flags)
    return terms


def near_pairs(batch: Batch, threshold: float) -> Array:
    """Return which pairs of points `[B, N, M]` are closer than `threshold` under the true pose."""
    assert batch.target_from_source is not None
    return squared_distances(batch.target_from_source.apply(batch.source), batch.target) < threshold**2


def overlap_labels(near: Array, masks: Pair) -> Pair:
    """Return which points overlap, `[B, N]` and `[B, M]`: those kept by their mask and near a kept point of the other cloud.

    Masked points have label 0 and count in the loss, as in the official code. `near`: as `near_pairs`.
    """
    kept = masks[0] > 0, masks[1] > 0
    both = near & kept[0][:, :, None] & kept[1][:, None]
    return jnp.any(both, axis=2), jnp.any(both, axis=1)


def _cross_entropy(logits: Array, label: Array, weights: tuple[float, float]) -> Array:
    """Return the mean of the cross-entropies, each weighted by its class; they are divided by the sum of the weights in the batch."""
    log = nn.log_softmax(logits, axis=-1)
    weight = jnp.where(label, weights[1], weights[0])
    return -jnp.sum(weight * jnp.where(label, log[..., 1], log[..., 0])) / jnp.sum(weight)


OMNET = Model(flags=OMNetFlags, build=OMNet, losses=losses)
