"""Shared multilayer perceptrons: the papers' 1x1 convolutions, applied to the channels of any array."""

from __future__ import annotations

from collections.abc import Callable

import flax.linen as nn
import jax
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.ops.moments import channels

# PyTorch's default for linear and convolution layers: uniform within 1 / sqrt(fan in).
torch_kernel = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")


def torch_bias(fan_in: int) -> Callable[[Array, tuple[int, ...]], Array]:
    """Return PyTorch's default initialiser of a bias: uniform within 1 / sqrt(fan in)."""
    bound = fan_in**-0.5
    return lambda key, shape: jax.random.uniform(key, shape, minval=-bound, maxval=bound)


class Dense(nn.Module):
    """A linear layer on the channels."""

    features: int
    use_bias: bool = True
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Map `x [..., C]` to `[..., features]`."""
        C = x.shape[-1]
        kernel = self.param("kernel", torch_kernel, (C, self.features))
        dtype = self.compute.dtype or kernel.dtype
        # Over one axis: where the kernel's derivative sums over several, XLA copies the points with their axes turned.
        flat = x.astype(dtype).reshape(-1, C) @ kernel.astype(dtype)
        y = flat.reshape(*x.shape[:-1], self.features)
        if not self.use_bias:
            return y
        bias = self.param("bias", torch_bias(C), (self.features,))
        return y + channels(bias.astype(dtype), y.ndim)


class Weights(nn.Module):
    """The parameters of a `Dense` layer, for callers that apply it themselves."""

    inputs: int
    features: int
    use_bias: bool = True

    @nn.compact
    def __call__(self) -> tuple[Array, Array | None]:
        """Return the kernel `[inputs, features]` and the bias `[features]`."""
        kernel = self.param("kernel", torch_kernel, (self.inputs, self.features))
        return kernel, self.param("bias", torch_bias(self.inputs), (self.features,)) if self.use_bias else None


class NormedMLP(nn.Module):
    """Layers of linear (no bias), BatchNorm, ReLU, one per width."""

    widths: tuple[int, ...]
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, x: Array, *, train: bool) -> Array:
        """Map `x [..., C]` to `[..., widths[-1]]`."""
        for i, width in enumerate(self.widths):
            x = Dense(width, use_bias=False, compute=self.compute, name=f"layer_{i}")(x)
            x = nn.relu(BatchNorm(width, compute=self.compute, name=f"norm_{i}")(x, train=train))
        return x


class MLP(nn.Module):
    """Linear layers with bias and ReLU between them, none after the last."""

    widths: tuple[int, ...]
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Map `x [..., C]` to `[..., widths[-1]]`."""
        for i, width in enumerate(self.widths):
            x = Dense(width, compute=self.compute, name=f"layer_{i}")(nn.relu(x) if i else x)
        return x
