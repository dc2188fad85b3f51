"""Layers of linear, GroupNorm and ReLU with a maximum over neighbours, in which the normalisation is folded into the linear layer.

The moments of `y = x W + b` follow from those of x: the mean is `mean(x) W + b`, the variance the diagonal of `W^T cov(x) W`. With them
the normalised layer is a linear layer again, with weights of its own for each sample. So a layer is two matrix products, and no pass over
its output computes statistics: with many positions and few channels those passes take most of the time.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.mlp import Weights
from cmig_jax.nn.norm import EPSILON
from cmig_jax.ops.pooling import selected_maximum

HIGHEST = jax.lax.Precision.HIGHEST


class FoldedMLP(nn.Module):
    """`NormedMLP(widths, norm="group", groups=groups, use_bias=True)` and the maximum over axis 2, with the same parameters."""

    widths: tuple[int, ...]
    groups: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Map `x [B, N, k, C]` to `[B, N, widths[-1]]`."""
        B, N, k, _ = x.shape
        hidden = x.reshape(B, N * k, -1)
        centre = _mean(hidden)  # coordinates far from the origin would cost the squares digits
        hidden, shift = hidden - centre[:, None], centre
        for i, width in enumerate(self.widths):
            kernel, bias = Weights(hidden.shape[-1], width, name=f"layer_{i}")()
            assert bias is not None
            scale, offset = Scale(width, name=f"norm_{i}")()
            bias = bias[None] + (jnp.matmul(shift, kernel, precision=HIGHEST) if i == 0 else 0)
            folded, offset = fold(hidden, kernel, bias, scale, offset, self.groups)
            dtype = self.compute.dtype or kernel.dtype
            product = jnp.einsum("bpc,bcd->bpd", hidden.astype(dtype), folded.astype(dtype))
            if i == len(self.widths) - 1:
                return nn.relu(selected_maximum(product.reshape(B, N, k, -1), 2) + offset[:, None].astype(dtype))
            hidden = nn.relu(product + offset[:, None].astype(dtype))
        return hidden


class Scale(nn.Module):
    """The parameters of a normalisation, for callers that apply it themselves."""

    features: int

    @nn.compact
    def __call__(self) -> tuple[Array, Array]:
        """Return scale and bias, `[features]` each."""
        shape = (self.features,)
        return self.param("scale", nn.initializers.ones, shape), self.param("bias", nn.initializers.zeros, shape)


def fold(x: Array, kernel: Array, bias: Array, scale: Array, offset: Array, groups: int) -> tuple[Array, Array]:
    """Fold GroupNorm into the linear layer before it.

    Args:
        x: `[B, P, C]` inputs of the layer.
        kernel: `[C, D]`.
        bias: `[1, D]` or `[B, D]`.
        scale, offset: `[D]` of the normalisation.
        groups: of the D channels.

    Returns:
        Kernels `[B, C, D]` and biases `[B, D]` of the normalised layer.
    """
    B, D = len(x), kernel.shape[1]
    wide = jnp.promote_types(x.dtype, jnp.float32)
    mean = _mean(x)
    square = jnp.einsum("bpc,bpd->bcd", x, x, precision=HIGHEST, preferred_element_type=wide) / x.shape[1]
    covariance = square - mean[:, :, None] * mean[:, None, :]
    centre = (jnp.matmul(mean, kernel, precision=HIGHEST) + bias).reshape(B, groups, -1)
    variance = jnp.sum(jnp.matmul(covariance, kernel, precision=HIGHEST) * kernel[None], axis=1).reshape(B, groups, -1)
    group_mean = jnp.mean(centre, axis=-1, keepdims=True)
    group_variance = jnp.mean(jnp.maximum(variance, 0) + (centre - group_mean) ** 2, axis=-1, keepdims=True)
    factor = (jax.lax.rsqrt(group_variance + EPSILON) * scale.reshape(1, groups, -1)).reshape(B, D)
    rest = jnp.broadcast_to(bias, (B, D)) - jnp.repeat(group_mean[..., 0], D // groups, axis=-1)
    return kernel[None] * factor[:, None], rest * factor + offset[None]


def _mean(x: Array) -> Array:
    """Return the mean `[B, C]` over the positions of `x [B, P, C]`, as a product: XLA's CPU compiler sums columns slowly."""
    wide = jnp.promote_types(x.dtype, jnp.float32)
    return jnp.einsum("p,bpc->bc", jnp.full(x.shape[1], 1 / x.shape[1], x.dtype), x, precision=HIGHEST, preferred_element_type=wide)
