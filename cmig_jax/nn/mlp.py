"""Shared multilayer perceptrons: the papers' 1x1 convolutions, applied to the channels of any array."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import flax.linen as nn
import jax
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.norm import BatchNorm, GroupNorm
from cmig_jax.ops.moments import channels

# PyTorch's default for linear and convolution layers: uniform within 1 / sqrt(fan in).
torch_kernel = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")


def torch_bias(fan_in: int) -> Callable[[Array, tuple[int, ...]], Array]:
    """Return PyTorch's default initialiser of a bias: uniform within 1 / sqrt(fan in)."""
    bound = fan_in**-0.5
    return lambda key, shape: jax.random.uniform(key, shape, minval=-bound, maxval=bound)


def activate(x: Array, negative_slope: float) -> Array:
    """Apply the leaky ReLU; ReLU for a slope of 0."""
    return nn.leaky_relu(x, negative_slope) if negative_slope else nn.relu(x)


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
    """Layers of linear, normalisation and (leaky) ReLU, one per width.

    Attributes:
        widths: channels of the layers.
        use_bias: of the linear layers.
        norm: over the batch and all positions (running statistics in evaluation), over groups of channels and all positions of one
            sample, or none.
        groups: of `norm="group"`, one number for all layers or one for each.
        negative_slope: of the activation; 0 is ReLU.
    """

    widths: tuple[int, ...]
    compute: ComputeConfig = ComputeConfig()
    use_bias: bool = False
    norm: Literal["batch", "group", "none"] = "batch"
    groups: int | tuple[int, ...] = 8
    negative_slope: float = 0.0

    @nn.compact
    def __call__(self, x: Array, *, train: bool) -> Array:
        """Map `x [..., C]` (`[B, ..., C]` for groups) to `[..., widths[-1]]`."""
        for i, width in enumerate(self.widths):
            x = Dense(width, use_bias=self.use_bias, compute=self.compute, name=f"layer_{i}")(x)
            if self.norm == "batch":
                x = BatchNorm(width, compute=self.compute, name=f"norm_{i}")(x, train=train)
            elif self.norm == "group":
                groups = self.groups if isinstance(self.groups, int) else self.groups[i]
                x = GroupNorm(groups, name=f"norm_{i}")(x)
            x = activate(x, self.negative_slope)
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
