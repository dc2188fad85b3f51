"""Networks over all pairs of keypoints (Sec. III-E, Fig. 5): a first layer on two sets of points, then layers to one number per pair."""

from __future__ import annotations

import itertools

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import COORDINATES, pair_distances
from cmig_jax.nn.mlp import Weights, torch_kernel
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.ops.moments import Affine
from cmig_jax.ops.pair_layers import PairValues, first_layer
from cmig_jax.ops.pairs import PairSum, PairTerm


class PairLayer(nn.Module):
    """The first layer over pairs: a matrix W on `[d, (b_j - a_i) / (d + 1e-8), extra_i]`, d = |b_j - a_i|, without bias.

    Of features, W's middle part is applied to each cloud and the difference taken afterwards: two products per point instead of one
    per pair. Coordinates are subtracted first: a source that the pose has brought onto the target is 1e-7 away from it, and the
    rounding of the difference of two products, divided by that, would dominate the batch statistics. `reverse` takes a_i - b_j, as the
    reference does for coordinates.
    """

    features: int
    reverse: bool = False
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, a: Array, b: Array, extra: Array | None = None) -> PairSum:
        """Map rows `a [B, N, C]`, columns `b [B, M, C]` and row numbers `extra [B, N, E]` to pairs of `features` channels."""
        C, E = a.shape[-1], 0 if extra is None else extra.shape[-1]
        kernel = self.param("kernel", torch_kernel, (1 + C + E, self.features))
        dtype, wide = self.compute.dtype or kernel.dtype, kernel.dtype
        length, direction, rest = jnp.split(kernel.astype(dtype), (1, 1 + C))
        distance = pair_distances(a, b)
        # No length, no direction: the factor 1e8 would magnify the rounding of the difference.
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


class PairNetwork(nn.Module):
    """The layers after the first: BatchNorm and ReLU, more layers of linear, BatchNorm, ReLU, and one number per pair.

    `pooled` also returns the last hidden layer's maximum over targets.
    """

    widths: tuple[int, ...]
    pooled: bool = False
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, pairs: PairSum, *, train: bool) -> tuple[Array, Array | None]:
        """Map pairs of `widths[0]` channels to similarities `[B, N, M]` and, if asked for, `[B, N, widths[-1]]`."""
        values = first_layer(pairs, max(self.widths), self.compute)
        affine = BatchNorm(self.widths[0], self.compute, name="first_norm").affine(values.moments() if train else None)
        values, affine = HiddenLayers(self.widths, self.compute, name="hidden")(values, affine, train=train)
        kernel, bias = Weights(self.widths[-1], 1, name="last")()
        assert bias is not None
        return values.last(affine, kernel.astype(self.compute.dtype or kernel.dtype), bias, self.pooled)


class HiddenLayers(nn.Module):
    """Layers of ReLU, linear (no bias), BatchNorm over pairs."""

    widths: tuple[int, ...]
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, values: PairValues, affine: Affine, *, train: bool) -> tuple[PairValues, Affine]:
        """Map values of `widths[0]` channels and their normalisation to those of `widths[-1]` channels."""
        for i, (inputs, width) in enumerate(itertools.pairwise(self.widths)):
            kernel, _ = Weights(inputs, width, use_bias=False, name=f"layer_{i}")()
            values = values.then(affine, kernel.astype(self.compute.dtype or kernel.dtype))
            affine = BatchNorm(width, self.compute, name=f"norm_{i}").affine(values.moments() if train else None)
        return values, affine
