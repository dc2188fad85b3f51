"""Distances and nearest neighbours between point sets, in any number of channels."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

HIGHEST = jax.lax.Precision.HIGHEST
T = TypeVar("T")


def squared_distances(a: Array, b: Array) -> Array:
    """Return squared Euclidean distances `[..., N, M]` between `a [..., N, C]` and `b [..., M, C]`, never negative.

    Both sets are centred on the mean of `b` first: |a|^2 - 2 ab + |b|^2 loses digits in proportion to the distance from the origin.
    """
    centre = jax.lax.stop_gradient(jnp.mean(b, axis=-2, keepdims=True))
    a, b = a - centre, b - centre
    product = jnp.einsum("...nc,...mc->...nm", a, b, precision=HIGHEST)
    norms = jnp.sum(a**2, axis=-1)[..., :, None] + jnp.sum(b**2, axis=-1)[..., None, :]
    return jnp.maximum(norms - 2 * product, 0)


def knn(points: Array, k: int, rows: int = 0) -> Array:
    """Return the indices `[..., N, k]` of the k nearest points of each point, itself included, nearest first.

    Args:
        points: `[..., N, C]`.
        k: neighbours, at most N.
        rows: rows of the distance matrix that exist at a time; 0: all.
    """
    points = jax.lax.stop_gradient(points)
    return map_rows(lambda query: jax.lax.top_k(-squared_distances(query, points), k)[1], points, rows)


def nearest(query: Array, points: Array, rows: int = 0) -> tuple[Array, Array]:
    """Return index `[..., N]` and distance `[..., N]` of the point of `points [..., M, C]` nearest to each of `query [..., N, C]`."""

    def block(q: Array) -> tuple[Array, Array]:
        square = squared_distances(q, points)
        return jnp.argmin(square, axis=-1), jnp.sqrt(jnp.min(square, axis=-1))

    return map_rows(block, jax.lax.stop_gradient(query), rows)


def map_rows(function: Callable[[Array], T], x: Array, rows: int) -> T:
    """Apply `function` to chunks of `rows` of the second-last axis of `x [..., N, C]` and join the results `[..., N, ...]` (0: at once).

    The results must carry the leading axes of `x` and then N. Chunks run one after another, so only one exists at a time.
    """
    count, lead = x.shape[-2], x.ndim - 2
    if rows == 0 or rows >= count:
        return function(x)
    padded = jnp.pad(x, [(0, 0)] * lead + [(0, -count % rows), (0, 0)])
    chunks = padded.reshape(*x.shape[:-2], -1, rows, x.shape[-1])
    results = jax.lax.map(function, jnp.moveaxis(chunks, lead, 0))

    def join(result: Array) -> Array:
        result = jnp.moveaxis(result, 0, lead)
        result = result.reshape(*result.shape[:lead], -1, *result.shape[lead + 2 :])
        return jax.lax.slice_in_dim(result, 0, count, axis=lead)

    return jax.tree.map(join, results)
