"""Correspondence search (Sec. III-E, Fig. 5) and the two heads of Table 8 that stand in for it.

All maps are over pairs of keypoints, source i (rows) and target j (columns). The cmignet head takes one similarity from features
and one from coordinates and adds them; the idam head takes one from both together; the pcrnet head regresses the pose.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.geometry.neighbors import squared_distances
from cmig_jax.geometry.rigid import rotation_from_quaternion
from cmig_jax.nn.mlp import MLP, Dense, NormedMLP, torch_kernel
from cmig_jax.nn.norm import BatchNorm, channels
from cmig_jax.structs import RigidTransform

CREDIBILITY_WIDTH = 32


@struct.dataclass
class Match:
    """Similarities of keypoint pairs `[B, K, K]` (the idam head has no coordinate one), and a credibility logit `[B, K]`."""

    feature: Array
    coordinate: Array | None
    logit: Array


@struct.dataclass
class KeypointSet:
    """Keypoints of one cloud: coordinates `[B, K, 3]` and hybrid features `[B, K, C]`."""

    points: Array
    features: Array


class CMIGNetHead(nn.Module):
    """The paper's head: features and coordinates guide the search independently.

    `rows` bounds memory: in evaluation so many source keypoints are compared at a time; in training BatchNorm needs all pairs, and
    the activations are recomputed instead of stored.
    """

    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    coordinate_widths: tuple[int, ...] = (32, 32, 32)
    rows: int = 0
    dtype: jnp.dtype | None = None

    def setup(self) -> None:
        self.feature_pairs = PairLayer(self.feature_widths[0], dtype=self.dtype)
        self.feature_tower = Tower(self.feature_widths, dtype=self.dtype)
        self.coordinate_pairs = PairLayer(self.coordinate_widths[0], reverse=True, dtype=self.dtype)
        self.coordinate_tower = Tower(self.coordinate_widths, dtype=self.dtype)
        self.pre = Dense(CREDIBILITY_WIDTH)
        self.credibility = Credibility()

    def __call__(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> Match:
        """Match source keypoints to target keypoints."""
        feature, coordinate, pooled = _by_rows(self, source, target, self.rows, train)
        return Match(feature=feature, coordinate=coordinate, logit=self.credibility(pooled, train=train))

    def block(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> tuple[Array, Array, Array]:
        """Compare rows of source keypoints with all target keypoints: `[B, R, K]` twice, `[B, R, 32]`."""
        feature, _ = self.feature_tower(self.feature_pairs(source.features, target.features), train=train)
        coordinate, _ = self.coordinate_tower(self.coordinate_pairs(source.points, target.points, source.points), train=train)
        pooled = jnp.max(self.pre(jnp.stack([feature, coordinate], axis=-1)), axis=-2)
        return feature, coordinate, pooled


class IDAMHead(nn.Module):
    """Features and coordinates in one similarity (after Li et al., ECCV 2020)."""

    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    rows: int = 0
    dtype: jnp.dtype | None = None

    def setup(self) -> None:
        self.feature_pairs = PairLayer(self.feature_widths[0], dtype=self.dtype)
        self.coordinate_pairs = PairLayer(self.feature_widths[0], reverse=True, dtype=self.dtype)
        self.tower = Tower(self.feature_widths, dtype=self.dtype)
        self.credibility = Credibility()

    def __call__(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> Match:
        """Match source keypoints to target keypoints."""
        similarity, pooled = _by_rows(self, source, target, self.rows, train)
        return Match(feature=similarity, coordinate=None, logit=self.credibility(pooled, train=train))

    def block(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> tuple[Array, Array]:
        """Compare rows of source keypoints with all target keypoints: `[B, R, K]`, `[B, R, C]`."""
        pairs = self.feature_pairs(source.features, target.features)
        pairs += self.coordinate_pairs(source.points, target.points, source.points)
        similarity, hidden = self.tower(pairs, train=train)
        return similarity, jnp.max(hidden, axis=-2).astype(similarity.dtype)


class PCRNetHead(nn.Module):
    """Regression of the pose from pooled keypoints (after Sarode et al., 2019); no correspondences."""

    width: int = 256
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, source: KeypointSet, target: KeypointSet) -> RigidTransform:
        """Return target_from_source `[B]` for this iteration."""
        encode = MLP((self.width, self.width), dtype=self.dtype, name="encode")
        pooled = [jnp.max(encode(jnp.concatenate([s.points, s.features], axis=-1)), axis=-2) for s in (source, target)]
        pose = MLP((self.width, self.width // 2, 7), dtype=self.dtype, name="pose")(jnp.concatenate(pooled, axis=-1))
        pose = pose.astype(source.points.dtype)
        upright = jnp.broadcast_to(jnp.array([1, 0, 0, 0], pose.dtype), (*pose.shape[:-1], 4))
        return RigidTransform(R=rotation_from_quaternion(pose[..., :4] + upright), t=pose[..., 4:])


class PairLayer(nn.Module):
    """The first layer over pairs: a matrix W on `[d, (b_j - a_i) / (d + 1e-8), extra_i]`, d = |b_j - a_i|, without bias.

    W's middle part is applied to each cloud and the difference taken afterwards: two products per point instead of one per pair.
    `reverse` takes a_i - b_j, as the reference does for coordinates.
    """

    features: int
    reverse: bool = False
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, a: Array, b: Array, extra: Array | None = None) -> Array:
        """Map rows `a [B, R, C]`, columns `b [B, K, C]` and row numbers `extra [B, R, E]` to `[B, R, K, features]`."""
        C, E = a.shape[-1], 0 if extra is None else extra.shape[-1]
        kernel = self.param("kernel", torch_kernel, (1 + C + E, self.features))
        dtype = self.dtype or kernel.dtype
        length, direction, rest = jnp.split(kernel.astype(dtype), (1, 1 + C))
        centre = jnp.mean(b, axis=-2, keepdims=True)  # cancels in the difference, and would cost it digits
        difference = ((b - centre).astype(dtype) @ direction)[:, None] - ((a - centre).astype(dtype) @ direction)[:, :, None]
        distance = pair_distances(a, b)[..., None]
        # No length, no direction: 1e-8 would blow up what rounding leaves of the difference.
        scale = jnp.where(distance > 0, 1 / (distance + 1e-8), 0).astype(dtype)
        pairs = distance.astype(dtype) * channels(length, 4) + difference * (-scale if self.reverse else scale)
        return pairs if extra is None else pairs + (extra.astype(dtype) @ rest)[:, :, None]


class Tower(nn.Module):
    """What follows the first layer: BatchNorm and ReLU, more such layers, and one number per pair."""

    widths: tuple[int, ...]
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, pairs: Array, *, train: bool) -> tuple[Array, Array]:
        """Map `pairs [B, R, K, widths[0]]` to similarities `[B, R, K]` and the last hidden layer `[B, R, K, widths[-1]]`."""
        hidden = nn.relu(BatchNorm(self.widths[0], name="first_norm")(pairs, train=train))
        hidden = NormedMLP(self.widths[1:], dtype=self.dtype, name="hidden")(hidden, train=train)
        similarity = Dense(1, dtype=self.dtype, name="last")(hidden)[..., 0]
        return similarity.astype(jnp.promote_types(pairs.dtype, jnp.float32)), hidden


class Credibility(nn.Module):
    """The matching score s(i) before its sigmoid, from what the pairs of a source keypoint say."""

    @nn.compact
    def __call__(self, pooled: Array, *, train: bool) -> Array:
        """Map `pooled [B, K, C]` to logits `[B, K]`."""
        hidden = NormedMLP((CREDIBILITY_WIDTH,), name="hidden")(pooled, train=train)
        return Dense(1, name="last")(hidden)[..., 0]


def pair_distances(a: Array, b: Array) -> Array:
    """Return distances `[B, R, K]` between `a [B, R, C]` and `b [B, K, C]`, with derivative 0 where they are 0.

    Coordinates are subtracted; for features that would be a tensor of C numbers per pair, so their distances come from products,
    and count as 0 below what rounding leaves of them.
    """
    if a.shape[-1] <= 3:
        square = jnp.sum((a[:, :, None] - b[:, None]) ** 2, axis=-1)
        zero = square == 0
    else:
        square = squared_distances(a, b)
        norms = jnp.sum(a**2, axis=-1)[:, :, None] + jnp.sum(b**2, axis=-1)[:, None]
        zero = square <= 4 * jnp.finfo(square.dtype).eps * norms
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, square)))


def _by_rows(head: CMIGNetHead | IDAMHead, source: KeypointSet, target: KeypointSet, rows: int, train: bool) -> tuple[Array, ...]:
    """Run `head.block`, whole, recomputed (training) or in chunks of `rows` source keypoints (evaluation)."""
    count = source.points.shape[1]
    if rows == 0 or head.is_initializing():
        return head.block(source, target, train=train)
    if train:
        return nn.remat(lambda head, s, t: head.block(s, t, train=True))(head, source, target)

    def chunked(x: Array) -> Array:
        padded = jnp.pad(x, [(0, 0), (0, -count % rows), (0, 0)])
        return padded.reshape(x.shape[0], -1, rows, x.shape[-1]).swapaxes(0, 1)

    scan = nn.scan(
        lambda head, carry, s: (carry, head.block(s, target, train=False)),
        variable_broadcast=("params", "batch_stats"),
        split_rngs={"params": False},
    )
    results = scan(head, (), jax.tree.map(chunked, source))[1]
    return tuple(r.swapaxes(0, 1).reshape(r.shape[1], -1, r.shape[-1])[:, :count] for r in results)
