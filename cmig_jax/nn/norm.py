"""Normalisation with PyTorch's meaning: the reference's numbers depend on which variance is stored and where epsilon stands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

EPSILON = 1e-5
MOMENTUM = 0.1


@struct.dataclass
class Moments:
    """Batch statistics per channel: mean `[C]`, population variance `[C]`, and the number of values behind them."""

    mean: Array
    variance: Array
    count: int = struct.field(pytree_node=False)


@struct.dataclass
class Affine:
    """What BatchNorm does to a channel: `(x - mean) * scale + bias`, each `[C]`."""

    mean: Array
    scale: Array
    bias: Array

    def __call__(self, x: Array) -> Array:
        """Normalise `x [..., C]`; the result has the type of `x`."""
        return (_scaled(x, self.mean, self.scale) + channels(self.bias, x.ndim)).astype(x.dtype)


def channels(vector: Array, ndim: int) -> Array:
    """View a vector `[C]` as `[1, ..., 1, C]`, so that it broadcasts over the channels of an array of `ndim` axes."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))


def moments(parts: Sequence[Array]) -> Moments:
    """Take mean and variance over everything but the channels, jointly over `parts` (each `[..., C]`), in float32 at least."""
    wide = [part.astype(jnp.promote_types(part.dtype, jnp.float32)) for part in parts]
    count = sum(part.size // part.shape[-1] for part in wide)
    mean = _total(_sum(part) for part in wide) / count
    variance = _total(_squares(part, mean) for part in wide) / count
    return Moments(mean=mean, variance=variance, count=count)


# What follows is differentiated by hand, so that only `x` is kept for it and not also `x - mean`. The derivatives say `mean - x`
# because XLA would find that `x - mean` has been computed before, and keep it.


@jax.custom_vjp
def _scaled(x: Array, mean: Array, scale: Array) -> Array:
    """Return `(x - mean) * scale` for `x [..., C]`."""
    return (x - channels(mean, x.ndim)) * channels(scale, x.ndim)


def _scaled_backward(saved: tuple[Array, Array, Array], gradient: Array) -> tuple[Array, Array, Array]:
    x, mean, scale = saved
    of_x = gradient * channels(scale, x.ndim)
    of_scale = -_sum(gradient * (channels(mean, x.ndim) - x))
    return of_x.astype(x.dtype), -_sum(gradient) * scale, of_scale


_scaled.defvjp(lambda x, mean, scale: (_scaled(x, mean, scale), (x, mean, scale)), _scaled_backward)


@jax.custom_vjp
def _squares(x: Array, mean: Array) -> Array:
    """Sum `(x - mean) ** 2` over everything but the channels."""
    return _sum((x - channels(mean, x.ndim)) ** 2)


def _squares_backward(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, mean = saved
    of_mean = 2 * channels(gradient, x.ndim) * (channels(mean, x.ndim) - x)
    return -of_mean, _sum(of_mean)


_squares.defvjp(lambda x, mean: (_squares(x, mean), (x, mean)), _squares_backward)


def _total(parts: Iterable[Array]) -> Array:
    return jnp.sum(jnp.stack(list(parts)), axis=0)


def _sum(x: Array) -> Array:
    return jnp.sum(x, axis=tuple(range(x.ndim - 1)))


class BatchNorm(nn.Module):
    """Batch normalisation over the global batch; the stored variance is the unbiased one, as in PyTorch.

    `affine` gives the transform for statistics that were taken elsewhere (a layer that never makes the whole activation);
    calling the module on `x [..., C]` takes them from `x`.
    """

    features: int

    def setup(self) -> None:
        self.scale = self.param("scale", nn.initializers.ones, (self.features,))
        self.bias = self.param("bias", nn.initializers.zeros, (self.features,))
        self.running_mean = self.variable("batch_stats", "mean", jnp.zeros, (self.features,))
        self.running_variance = self.variable("batch_stats", "var", jnp.ones, (self.features,))

    def __call__(self, x: Array, *, train: bool) -> Array:
        """Normalise `x [..., C]`."""
        return self.affine(moments([x]) if train else None)(x)

    def affine(self, batch: Moments | None) -> Affine:
        """Return the transform for these batch statistics, and record them; None takes the running ones."""
        mean, variance = self.running_mean.value, self.running_variance.value
        if batch is not None:
            if not self.is_initializing():
                unbiased = batch.variance * (batch.count / max(batch.count - 1, 1))
                self.running_mean.value = jax.lax.stop_gradient((1 - MOMENTUM) * mean + MOMENTUM * batch.mean)
                self.running_variance.value = jax.lax.stop_gradient((1 - MOMENTUM) * variance + MOMENTUM * unbiased)
            mean, variance = batch.mean, batch.variance
        return Affine(mean=mean, scale=self.scale * jax.lax.rsqrt(variance + EPSILON), bias=self.bias)


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
