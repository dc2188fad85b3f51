"""Mask prediction: significance scores, and the choice of keypoints (Sec. III-D)."""

from __future__ import annotations

from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.models.cmignet.prediction import Keypoints
from cmig_jax.nn.mlp import MLP, torch_kernel
from cmig_jax.ops.moments import channels
from cmig_jax.ops.neighbours import nearest, top_k
from cmig_jax.transform import RigidTransform


class SignificanceScore(nn.Module):
    """Scores points from their own features beside the other cloud's pooled vector."""

    dim: int = 512
    activation: Literal["linear", "sigmoid"] = "linear"
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, points: Array, pooled: Array) -> Array:
        """Score `points [B, N, C]` given a cloud vector `pooled [B, C]`, to `[B, N]`."""
        C = points.shape[-1]
        kernel = self.param("kernel", torch_kernel, (2 * C, self.dim))
        bias = self.param("bias", nn.initializers.zeros, (self.dim,))
        dtype = self.compute.dtype or kernel.dtype
        own, other = jnp.split(kernel.astype(dtype), 2)
        # The layer on [points, pooled repeated], with the repeated part computed once.
        hidden = points.astype(dtype) @ own + (pooled.astype(dtype) @ other)[:, None, :] + channels(bias.astype(dtype), 3)
        score = MLP((self.dim // 2, self.dim // 4, 1), self.compute, name="rest")(nn.relu(hidden))[..., 0]
        score = score.astype(points.dtype)
        return nn.sigmoid(score) if self.activation == "sigmoid" else score


def random_points(key: Array, clouds: int, points: int, count: int) -> Array:
    """Draw `count` of `points` without replacement, the same draw for each of `clouds`: `[clouds, count]`."""
    return jnp.broadcast_to(jax.random.permutation(key, points)[:count], (clouds, count))


def draw_for_training(key: Array, label: Array, count: int) -> Array:
    """Draw half of `count` points among those with a true correspondent and half among those without.

    Without replacement within a half; a point's probability is proportional to label + 1e-5 in the one and to 1 - label + 1e-5 in
    the other (so a half that runs out of its own kind fills up with the other).

    Args:
        key: random key.
        label: `[B, N]`, 1 or 0.
        count: K.

    Returns:
        indices `[B, K]`.
    """
    keys = jax.random.split(key)
    halves = [(keys[0], label, count // 2), (keys[1], 1 - label, count - count // 2)]
    drawn = [top_k(jnp.log(p + 1e-5) + jax.random.gumbel(k, p.shape, p.dtype), n) for k, p, n in halves]
    return jnp.concatenate(drawn, axis=-1)


def true_correspondents(source: Array, target: Array, pose: RigidTransform, threshold: float, rows: int = 0) -> tuple[Array, Array]:
    """Return for each source point `[B, N, 3]` its nearest target point `[B, M, 3]` under the true pose, `[B, N]`, and the label.

    The label `[B, N]` is 1 where that point is closer than `threshold`.
    """
    index, distance = jax.vmap(lambda x, y: nearest(x, y, rows))(pose.apply(source), target)
    return index, (distance < threshold).astype(source.dtype)


def pair_in_order(source_index: Array, correspondent: Array, label: Array) -> Keypoints:
    """Choose as target keypoints the correspondents of the source keypoints, in the same order.

    Args:
        source_index: `[B, K]`.
        correspondent, label: `[B, N]` of `true_correspondents`.
    """
    order = jnp.broadcast_to(jnp.arange(source_index.shape[1]), source_index.shape)
    return Keypoints(
        source_index=source_index,
        target_index=jnp.take_along_axis(correspondent, source_index, axis=1),
        match_index=order,
        match_label=jnp.take_along_axis(label, source_index, axis=1),
    )
