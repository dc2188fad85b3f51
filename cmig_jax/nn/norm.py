"""Normalisation with PyTorch's meaning: which variance is stored, and where epsilon stands."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.ops.moments import Affine, Moments, channels, moments

EPSILON = 1e-5
MOMENTUM = 0.1


class BatchNorm(nn.Module):
    """Batch normalisation over the global batch; the stored variance is the unbiased one, as in PyTorch.

    `affine` returns the normalisation for statistics that were computed elsewhere (a layer that never makes its whole activation);
    calling the module computes them from its input.
    """

    features: int
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.scale = self.param("scale", nn.initializers.ones, (self.features,))
        self.bias = self.param("bias", nn.initializers.zeros, (self.features,))
        self.running_mean = self.variable("batch_stats", "mean", jnp.zeros, (self.features,))
        self.running_variance = self.variable("batch_stats", "var", jnp.ones, (self.features,))

    def __call__(self, x: Array, *, train: bool) -> Array:
        """Normalise `x [..., C]`."""
        return self.affine(moments([x], self.compute.kernels) if train else None)(x)

    def affine(self, batch: Moments | None) -> Affine:
        """Return the normalisation for these batch statistics, and record them; None takes the running statistics."""
        mean, variance = self.running_mean.value, self.running_variance.value
        if batch is not None:
            if not self.is_initializing():
                unbiased = batch.variance * (batch.count / max(batch.count - 1, 1))
                self.running_mean.value = jax.lax.stop_gradient((1 - MOMENTUM) * mean + MOMENTUM * batch.mean)
                self.running_variance.value = jax.lax.stop_gradient((1 - MOMENTUM) * variance + MOMENTUM * unbiased)
            mean, variance = batch.mean, batch.variance
        return Affine(mean=mean, scale=self.scale * jax.lax.rsqrt(variance + EPSILON), bias=self.bias, kernels=self.compute.kernels)


class GroupNorm(nn.Module):
    """Normalisation of each sample over groups of consecutive channels and all positions (Wu and He, ECCV 2018)."""

    groups: int

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Normalise `x [B, ..., C]`."""
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        bias = self.param("bias", nn.initializers.zeros, (x.shape[-1],))
        wide = x.astype(jnp.promote_types(x.dtype, jnp.float32)).reshape(x.shape[0], -1, self.groups, x.shape[-1] // self.groups)
        centred = wide - jnp.mean(wide, axis=(1, 3), keepdims=True)
        variance = jnp.mean(centred**2, axis=(1, 3), keepdims=True)
        normed = (centred * jax.lax.rsqrt(variance + EPSILON)).reshape(x.shape)
        return (normed * channels(scale, x.ndim) + channels(bias, x.ndim)).astype(x.dtype)


class LayerNorm(nn.Module):
    """Layer normalisation with the unbiased standard deviation and epsilon outside the root, as in the reference's transformer."""

    epsilon: float = 1e-6

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Normalise the channels of `x [..., C]`."""
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        bias = self.param("bias", nn.initializers.zeros, (x.shape[-1],))
        wide = x.astype(jnp.promote_types(x.dtype, jnp.float32))
        centred = wide - jnp.mean(wide, axis=-1, keepdims=True)
        variance = jnp.sum(centred**2, axis=-1, keepdims=True) / (x.shape[-1] - 1)
        constant = variance == 0  # the root has no derivative there
        deviation = jnp.where(constant, 0, jnp.sqrt(jnp.where(constant, 1, variance)))
        return (channels(scale, x.ndim) * centred / (deviation + self.epsilon) + channels(bias, x.ndim)).astype(x.dtype)
