"""Distances between point sets, in any number of channels."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

HIGHEST = jax.lax.Precision.HIGHEST
COORDINATES = 3


def squared_distances(a: Array, b: Array) -> Array:
    """Return squared Euclidean distances `[..., N, M]` between `a [..., N, C]` and `b [..., M, C]`, never negative.

    Both sets are centred on the mean of `b` first: |a|^2 - 2 ab + |b|^2 loses digits in proportion to the distance from the origin.
    """
    centre = jax.lax.stop_gradient(jnp.mean(b, axis=-2, keepdims=True))
    a, b = a - centre, b - centre
    product = jnp.einsum("...nc,...mc->...nm", a, b, precision=HIGHEST)
    norms = jnp.sum(a**2, axis=-1)[..., :, None] + jnp.sum(b**2, axis=-1)[..., None, :]
    return jnp.maximum(norms - 2 * product, 0)


def pair_distances(a: Array, b: Array) -> Array:
    """Return distances `[B, N, M]` between `a [B, N, C]` and `b [B, M, C]`, with derivative 0 where they are 0.

    Coordinates are subtracted. The difference of features would have C values per pair, so their distances come from products, and
    count as 0 where they are smaller than the rounding of those.
    """
    if a.shape[-1] <= COORDINATES:
        square = jnp.sum((a[:, :, None] - b[:, None]) ** 2, axis=-1)
        zero = square == 0
    else:
        square = squared_distances(a, b)
        norms = jnp.sum(a**2, axis=-1)[:, :, None] + jnp.sum(b**2, axis=-1)[:, None]
        zero = square <= 4 * jnp.finfo(square.dtype).eps * norms
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, square)))
