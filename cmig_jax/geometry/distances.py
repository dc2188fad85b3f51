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


def chamfer_distance(a: Array, b: Array) -> Array:
    """Return the mean distance from a point to the nearest of the other set, averaged over both directions, `[...]`.

    Distances are not squared; where one is 0, so is its derivative.

    Args:
        a: `[..., N, C]` points.
        b: `[..., M, C]` points.
    """
    square = squared_distances(*jax.lax.stop_gradient((a, b)))
    of_a, of_b = jnp.argmin(square, axis=-1)[..., None], jnp.argmin(square, axis=-2)[..., None]
    there = length(a - jnp.take_along_axis(b, of_a, axis=-2))
    back = length(b - jnp.take_along_axis(a, of_b, axis=-2))
    return (jnp.mean(there, axis=-1) + jnp.mean(back, axis=-1)) / 2


def length(x: Array) -> Array:
    """Return the Euclidean length of vectors `[..., C]`, with derivative 0 where it is 0."""
    square = jnp.sum(x**2, axis=-1)
    return jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square)))
