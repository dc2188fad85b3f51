"""Batch statistics per channel, and the normalisation that uses them.

The fast derivatives keep only `x`; JAX's own also keep `x - mean`, which doubles the memory of a normalisation. They compute `mean - x`
because XLA would recognise `x - mean` as computed before, and keep it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import Kernels
from cmig_jax.ops.kernels import is_fast


@struct.dataclass
class Moments:
    """Batch statistics per channel: mean `[C]`, population variance `[C]`, and the number of values behind them."""

    mean: Array
    variance: Array
    count: int = struct.field(pytree_node=False)


@struct.dataclass
class Affine:
    """What a normalisation does to a channel: `(x - mean) * scale + bias`, each `[C]`."""

    mean: Array
    scale: Array
    bias: Array
    kernels: Kernels = struct.field(pytree_node=False, default="auto")

    def __call__(self, x: Array) -> Array:
        """Normalise `x [..., C]`; the result has the type of `x`."""
        return (scale_about(x, self.mean, self.scale, self.kernels) + channels(self.bias, x.ndim)).astype(x.dtype)


def channels(vector: Array, ndim: int) -> Array:
    """View a vector `[C]` as `[1, ..., 1, C]`, so that it broadcasts over the channels of an array of `ndim` axes."""
    return vector.reshape((1,) * (ndim - 1) + (-1,))


def moments(parts: Sequence[Array], kernels: Kernels = "auto") -> Moments:
    """Return mean and variance over all axes but the channels, jointly over `parts` (each `[..., C]`), in float32 at least."""
    wide = [part.astype(jnp.promote_types(part.dtype, jnp.float32)) for part in parts]
    count = sum(part.size // part.shape[-1] for part in wide)
    squares = _squares if is_fast(kernels) else _plain_squares
    mean = _total(_sum(part) for part in wide) / count
    variance = _total(squares(part, mean) for part in wide) / count
    return Moments(mean=mean, variance=variance, count=count)


def join_moments(parts: Moments, counts: Array | None = None) -> Moments:
    """Join the moments `[n, C]` of n parts of equal size, or of sizes in proportion to `counts [n]`; `parts.count` is their total."""
    n = parts.mean.shape[0]
    weight = jnp.full((n, 1), 1 / n, parts.mean.dtype) if counts is None else (counts / jnp.sum(counts))[:, None]
    mean = jnp.sum(weight * parts.mean, axis=0)
    variance = jnp.sum(weight * (parts.variance + (parts.mean - mean[None]) ** 2), axis=0)
    return Moments(mean=mean, variance=variance, count=parts.count)


def scale_about(x: Array, mean: Array, scale: Array, kernels: Kernels = "auto") -> Array:
    """Return `(x - mean) * scale` for `x [..., C]`, `mean [C]`, `scale [C]`."""
    return (_scale_about if is_fast(kernels) else _plain_scale_about)(x, mean, scale)


def _plain_scale_about(x: Array, mean: Array, scale: Array) -> Array:
    return (x - channels(mean, x.ndim)) * channels(scale, x.ndim)


_scale_about = jax.custom_vjp(_plain_scale_about)


def _scale_about_backward(saved: tuple[Array, Array, Array], gradient: Array) -> tuple[Array, Array, Array]:
    x, mean, scale = saved
    of_x = gradient * channels(scale, x.ndim)
    of_scale = -_sum(gradient * (channels(mean, x.ndim) - x))
    return of_x.astype(x.dtype), -_sum(gradient) * scale, of_scale


_scale_about.defvjp(lambda x, mean, scale: (_scale_about(x, mean, scale), (x, mean, scale)), _scale_about_backward)


def _plain_squares(x: Array, mean: Array) -> Array:
    """Sum `(x - mean) ** 2` over all axes but the channels."""
    return _sum((x - channels(mean, x.ndim)) ** 2)


_squares = jax.custom_vjp(_plain_squares)


def _squares_backward(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, mean = saved
    of_mean = 2 * channels(gradient, x.ndim) * (channels(mean, x.ndim) - x)
    return -of_mean, _sum(of_mean)


_squares.defvjp(lambda x, mean: (_squares(x, mean), (x, mean)), _squares_backward)


def _total(parts: Iterable[Array]) -> Array:
    return jnp.sum(jnp.stack(list(parts)), axis=0)


def _sum(x: Array) -> Array:
    return jnp.sum(x, axis=tuple(range(x.ndim - 1)))
