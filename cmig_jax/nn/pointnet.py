"""PointNet (Qi et al., CVPR 2017): a shared multilayer perceptron on the coordinates of every point, and a maximum over the points."""

from __future__ import annotations

from typing import Literal

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.mlp import NormedMLP, Weights
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.ops.moments import channels
from cmig_jax.ops.pooling import maximum


class PointNet(nn.Module):
    """Layers of linear (with bias), normalisation or none, and ReLU, for every point; without the transforms of the original.

    Attributes:
        widths: channels of the layers.
        norm: normalisation over the batch and its points, or none.
    """

    widths: tuple[int, ...]
    norm: Literal["batch", "none"] = "batch"
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        *hidden, features = self.widths
        self.layers = NormedMLP(tuple(hidden), self.compute, use_bias=True, norm=self.norm)
        self.last = Weights((3, *hidden)[-1], features)
        if self.norm == "batch":
            self.last_norm = BatchNorm(features, self.compute)

    def __call__(self, points: Array, *, train: bool) -> Array:
        """Encode every point of `[B, N, 3]`, to `[B, N, C]`."""
        return self._last(points, "bnd,dc->bnc", train)

    def channelwise(self, points: Array) -> Array:
        """Return channel c of the feature of point c alone, for C points `[B, C, 3]`: `[B, C]`, in evaluation mode."""
        return self._last(points, "bcd,dc->bc", train=False)

    def _last(self, points: Array, product: str, train: bool) -> Array:
        hidden = self.layers(points, train=train)
        kernel, bias = self.last()
        dtype = self.compute.dtype or kernel.dtype
        x = jnp.einsum(product, hidden.astype(dtype), kernel.astype(dtype))
        if bias is not None:
            x += channels(bias.astype(dtype), x.ndim)
        x = self.last_norm(x, train=train) if self.norm == "batch" else x
        return nn.relu(x).astype(points.dtype)

    def pooled(self, points: Array, *, train: bool) -> Array:
        """Encode the clouds `[B, N, 3]`, to `[B, C]`."""
        return maximum(self(points, train=train), 1, self.compute.kernels)


class DenseBesidePooled(nn.Module):
    """A linear layer on `[point, cloud]`: features of every point beside one vector of a whole cloud.

    The cloud's part is computed once instead of for every point. The parameters are those of a `Dense` layer on both.
    """

    features: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, points: Array, pooled: Array) -> Array:
        """Map `points [B, N, C]` and `pooled [B, D]` to `[B, N, features]`."""
        C, D = points.shape[-1], pooled.shape[-1]
        kernel, bias = Weights(C + D, self.features, name="layer")()
        dtype = self.compute.dtype or kernel.dtype
        own, other = jnp.split(kernel.astype(dtype), [C])
        cloud = pooled.astype(dtype) @ other
        if bias is not None:
            cloud += channels(bias.astype(dtype), 2)
        return points.astype(dtype) @ own + cloud[:, None, :]
