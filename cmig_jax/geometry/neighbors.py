"""Distances and nearest neighbours between point sets, in any number of channels."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec

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

    def block(query: Array) -> Array:
        square = squared_distances(query, points)
        # In two axes: XLA's CPU compiler merges slices of the result into a top-k of more axes and then sorts whole rows.
        return top_k(-square.reshape(-1, square.shape[-1]), k).reshape(*square.shape[:-1], k)

    return map_rows(block, points, rows)


def top_k(x: Array, k: int) -> Array:
    """Return the indices `[B, k]` of the k largest of each row of `x [B, N]`, largest first.

    Under the mesh of several devices (`jax.sharding.use_abstract_mesh`) each sorts its own rows; XLA by itself gathers all rows on all.
    """
    mesh = jax.sharding.get_abstract_mesh()

    def own_rows(x: Array) -> Array:
        return jax.lax.top_k(x, k)[1]

    if mesh.size == 1 or mesh.empty:
        return own_rows(x)
    rows = PartitionSpec(mesh.axis_names)
    return jax.shard_map(own_rows, mesh=mesh, in_specs=rows, out_specs=rows)(x)


def nearest(query: Array, points: Array, rows: int = 0) -> tuple[Array, Array]:
    """Return index `[..., N]` and distance `[..., N]` of the point of `points [..., M, C]` nearest to each of `query [..., N, C]`."""

    def block(q: Array) -> tuple[Array, Array]:
        square = squared_distances(q, points)
        return jnp.argmin(square, axis=-1), jnp.sqrt(jnp.min(square, axis=-1))

    return map_rows(block, jax.lax.stop_gradient(query), rows)


@jax.custom_vjp
def neighbour_maximum(x: Array, neighbours: Array) -> Array:
    """Return the maximum over each point's neighbours, per channel.

    The derivative goes to the neighbour that gave the maximum (the nearest of equal ones): one number per point and channel is
    scattered, where differentiating the gather would scatter one per edge.

    Args:
        x: `[B, N, C]`.
        neighbours: `[B, N, k]` indices into N.

    Returns:
        `[B, N, C]`.
    """
    return _maximum_and_source(x, neighbours)[0]


def _maximum_and_source(x: Array, neighbours: Array) -> tuple[Array, Array]:
    def visit(best: tuple[Array, Array], index: Array) -> tuple[tuple[Array, Array], None]:
        value, source = best
        candidate = jnp.take_along_axis(x, index[..., None], axis=1)
        better = candidate > value
        return (jnp.where(better, candidate, value), jnp.where(better, index[..., None], source)), None

    start = jnp.full_like(x, -jnp.inf), jnp.broadcast_to(neighbours[..., :1], x.shape)
    return jax.lax.scan(visit, start, jnp.moveaxis(neighbours, -1, 0), unroll=True)[0]


def _neighbour_maximum_forward(x: Array, neighbours: Array) -> tuple[Array, Array]:
    return _maximum_and_source(x, neighbours)


def _neighbour_maximum_backward(source: Array, gradient: Array) -> tuple[Array, None]:
    channel = jnp.arange(gradient.shape[-1])[None, :]
    scatter = jax.vmap(lambda g, s: jnp.zeros_like(g).at[s, channel].add(g))
    return scatter(gradient, source), None


neighbour_maximum.defvjp(_neighbour_maximum_forward, _neighbour_maximum_backward)


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
