"""Correspondence search (Sec. III-E, Fig. 5) and the two heads of Table 8 that stand in for it.

All maps are over pairs of keypoints, source i (rows) and target j (columns). The cmignet head takes one similarity from features
and one from coordinates and adds them; the idam head takes one from both together; the pcrnet head regresses the pose.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.geometry.maximum import maximum
from cmig_jax.geometry.neighbors import squared_distances
from cmig_jax.geometry.rigid import rotation_from_quaternion
from cmig_jax.nn.mlp import MLP, Dense, NormedMLP, Weights, torch_kernel
from cmig_jax.nn.norm import channels
from cmig_jax.nn.pairs import PairSum, PairTerm
from cmig_jax.nn.tower import Tower, chunks_of, joined
from cmig_jax.structs import RigidTransform

CREDIBILITY_WIDTH = 32
COORDINATES = 3


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

    `rows` source keypoints are compared at a time (0: as many as suit the machine).
    """

    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    coordinate_widths: tuple[int, ...] = (32, 32, 32)
    rows: int = 0
    dtype: jnp.dtype | None = None

    def setup(self) -> None:
        self.feature_pairs = PairLayer(self.feature_widths[0], dtype=self.dtype)
        self.feature_tower = Tower(self.feature_widths, rows=self.rows, dtype=self.dtype)
        self.coordinate_pairs = PairLayer(self.coordinate_widths[0], reverse=True, dtype=self.dtype)
        self.coordinate_tower = Tower(self.coordinate_widths, rows=self.rows, dtype=self.dtype)
        self.pre = Weights(2, CREDIBILITY_WIDTH)
        self.credibility = Credibility()

    def __call__(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> Match:
        """Match source keypoints to target keypoints."""
        feature, _ = self.feature_tower(self.feature_pairs(source.features, target.features), train=train)
        coordinate, _ = self.coordinate_tower(self.coordinate_pairs(source.points, target.points, source.points), train=train)
        pooled = _best_of_targets(self.pre(), feature, coordinate, self.rows)
        return Match(feature=feature, coordinate=coordinate, logit=self.credibility(pooled, train=train))


class IDAMHead(nn.Module):
    """Features and coordinates in one similarity (after Li et al., ECCV 2020)."""

    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    rows: int = 0
    dtype: jnp.dtype | None = None

    def setup(self) -> None:
        self.feature_pairs = PairLayer(self.feature_widths[0], dtype=self.dtype)
        self.coordinate_pairs = PairLayer(self.feature_widths[0], reverse=True, dtype=self.dtype)
        self.tower = Tower(self.feature_widths, rows=self.rows, pooled=True, dtype=self.dtype)
        self.credibility = Credibility()

    def __call__(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> Match:
        """Match source keypoints to target keypoints."""
        features = self.feature_pairs(source.features, target.features)
        coordinates = self.coordinate_pairs(source.points, target.points, source.points)
        similarity, pooled = self.tower(features + coordinates, train=train)
        assert pooled is not None
        return Match(feature=similarity, coordinate=None, logit=self.credibility(pooled, train=train))


class PCRNetHead(nn.Module):
    """Regression of the pose from pooled keypoints (after Sarode et al., 2019); no correspondences."""

    width: int = 256
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, source: KeypointSet, target: KeypointSet) -> RigidTransform:
        """Return target_from_source `[B]` for this iteration."""
        encode = MLP((self.width, self.width), dtype=self.dtype, name="encode")
        pooled = [maximum(encode(jnp.concatenate([s.points, s.features], axis=-1)), 1) for s in (source, target)]
        pose = MLP((self.width, self.width // 2, 7), dtype=self.dtype, name="pose")(jnp.concatenate(pooled, axis=-1))
        pose = pose.astype(source.points.dtype)
        upright = jnp.broadcast_to(jnp.array([1, 0, 0, 0], pose.dtype), (*pose.shape[:-1], 4))
        return RigidTransform(R=rotation_from_quaternion(pose[..., :4] + upright), t=pose[..., 4:])


class PairLayer(nn.Module):
    """The first layer over pairs: a matrix W on `[d, (b_j - a_i) / (d + 1e-8), extra_i]`, d = |b_j - a_i|, without bias.

    Of features, W's middle part is applied to each cloud and the difference taken afterwards: two products per point instead of one
    per pair. Coordinates are subtracted first: a source that the pose has brought onto the target is 1e-7 from it, and what rounding
    leaves of the difference of two products, divided by that, would swamp the batch statistics. `reverse` takes a_i - b_j, as the
    reference does for coordinates.
    """

    features: int
    reverse: bool = False
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, a: Array, b: Array, extra: Array | None = None) -> PairSum:
        """Map rows `a [B, N, C]`, columns `b [B, M, C]` and row numbers `extra [B, N, E]` to pairs of `features` channels."""
        C, E = a.shape[-1], 0 if extra is None else extra.shape[-1]
        kernel = self.param("kernel", torch_kernel, (1 + C + E, self.features))
        dtype, wide = self.dtype or kernel.dtype, kernel.dtype
        length, direction, rest = jnp.split(kernel.astype(dtype), (1, 1 + C))
        distance = pair_distances(a, b)
        # No length, no direction: 1e-8 would blow up what rounding leaves of the difference.
        scale = jnp.where(distance > 0, 1 / (distance + 1e-8), 0)
        scale = -scale if self.reverse else scale
        terms = (PairTerm(distance, None, length.astype(wide)[None]),)
        if C <= COORDINATES:
            unit = (b[:, None] - a[:, :, None]) * scale[..., None]
            terms += tuple(PairTerm(unit[..., c], None, direction.astype(wide)[None, c : c + 1]) for c in range(C))
        else:
            centre = jnp.mean(b, axis=-2, keepdims=True)  # cancels in the difference, and would cost it digits
            row, column = (((x - centre).astype(dtype) @ direction).astype(wide) for x in (a, b))
            terms += (PairTerm(scale, -row, column),)
        own = jnp.zeros((*a.shape[:2], self.features), wide) if extra is None else (extra.astype(dtype) @ rest).astype(wide)
        return PairSum(own, terms)


class Credibility(nn.Module):
    """The matching score s(i) before its sigmoid, from what the pairs of a source keypoint say."""

    @nn.compact
    def __call__(self, pooled: Array, *, train: bool) -> Array:
        """Map `pooled [B, K, C]` to logits `[B, K]`."""
        hidden = NormedMLP((CREDIBILITY_WIDTH,), name="hidden")(pooled, train=train)
        return Dense(1, name="last")(hidden)[..., 0]


def _best_of_targets(parameters: tuple[Array, Array | None], feature: Array, coordinate: Array, rows: int) -> Array:
    """Apply a linear layer to each pair's two similarities `[B, N, M]`, and take the maximum over targets: `[B, N, C]`."""
    kernel, bias = parameters
    assert bias is not None
    return _largest_sum(kernel, feature, coordinate, rows) + channels(bias, 3)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _largest_sum(kernel: Array, feature: Array, coordinate: Array, rows: int) -> Array:
    """Return the maximum over targets of `kernel[0] feature_ij + kernel[1] coordinate_ij`, without its values at all pairs."""
    return _over_targets(jnp.max, kernel, feature, coordinate, rows)


@_largest_sum.defjvp
def _largest_sum_jvp(rows: int, primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    """Differentiate only the pairs that have the maximum."""
    kernel, feature, coordinate = primals
    index = _over_targets(jnp.argmax, kernel, feature, coordinate, rows)

    def at_best(kernel: Array, feature: Array, coordinate: Array) -> Array:
        own, other = (jnp.take_along_axis(x, index, axis=2) for x in (feature, coordinate))
        return own * channels(kernel[0], 3) + other * channels(kernel[1], 3)

    return jax.jvp(at_best, primals, tangents)


def _over_targets(reduce: Callable[..., Array], kernel: Array, feature: Array, coordinate: Array, rows: int) -> Array:
    """Reduce `kernel[0] feature_ij + kernel[1] coordinate_ij`, `[B, N, M, C]`, over M, a chunk of rows at a time."""
    B, N, M = feature.shape
    split = chunks_of(B, N, M, kernel.shape[-1], rows)

    def visit(chunk: tuple[Array, Array]) -> Array:
        return reduce(chunk[0][..., None] * channels(kernel[0], 4) + chunk[1][..., None] * channels(kernel[1], 4), axis=2)

    return joined(jax.lax.map(visit, (split(feature), split(coordinate))))


def pair_distances(a: Array, b: Array) -> Array:
    """Return distances `[B, R, K]` between `a [B, R, C]` and `b [B, K, C]`, with derivative 0 where they are 0.

    Coordinates are subtracted; for features that would be a tensor of C numbers per pair, so their distances come from products,
    and count as 0 below what rounding leaves of them.
    """
    if a.shape[-1] <= COORDINATES:
        square = jnp.sum((a[:, :, None] - b[:, None]) ** 2, axis=-1)
        zero = square == 0
    else:
        square = squared_distances(a, b)
        norms = jnp.sum(a**2, axis=-1)[:, :, None] + jnp.sum(b**2, axis=-1)[:, None]
        zero = square <= 4 * jnp.finfo(square.dtype).eps * norms
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, square)))
