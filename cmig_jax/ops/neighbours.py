"""Nearest neighbours between point sets, in any number of channels."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import squared_distances
from cmig_jax.ops.chunks import map_rows
from cmig_jax.ops.kernels import is_fast


def knn(points: Array, k: int, compute: ComputeConfig) -> Array:
    """Return the indices `[..., N, k]` of the k nearest points of each point, itself included, nearest first.

    Args:
        points: `[..., N, C]`.
        k: neighbours, at most N.
        compute: `kernels`, and `rows`, the rows of the distance matrix per chunk.
    """
    points = jax.lax.stop_gradient(points)

    def block(query: Array) -> Array:
        square = squared_distances(query, points)
        if not is_fast(compute.kernels):
            return top_k(-square, k)
        # With two axes: XLA's CPU compiler merges slices of the result into a top-k of more axes and then sorts whole rows.
        return top_k(-square.reshape(-1, square.shape[-1]), k).reshape(*square.shape[:-1], k)

    return map_rows(block, points, compute.rows)


def within_radius(points: Array, radius: float, k: int, by: Literal["index", "nearest"], compute: ComputeConfig) -> Array:
    """Return the indices `[..., N, k]` of up to k points within a radius (inclusive) of each point, itself left out.

    Where there are fewer than k, the rest is the point itself.

    Args:
        points: `[..., N, C]`.
        radius: in the unit of the points.
        k: neighbours.
        by: which ones if there are more than k, and in which order: the first by index, or the nearest.
        compute: `kernels`, and `rows`, the rows of the distance matrix per chunk.
    """
    points = jax.lax.stop_gradient(points)
    N = points.shape[-2]
    column = jnp.arange(N)

    def block(own: Array) -> Array:
        square = squared_distances(jnp.take_along_axis(points, own, axis=-2), points)
        inside = (square <= radius**2) & (own != column.reshape((1,) * (own.ndim - 1) + (N,)))
        # float32, which holds every index below 2**24: XLA's CPU compiler has a fast top-k for no other type.
        order = jnp.broadcast_to(column, inside.shape) if by == "index" else square
        score = jnp.where(inside, -order.astype(jnp.float32), -jnp.inf)
        chosen = top_k(score.reshape(-1, N), min(k, N)).reshape(*inside.shape[:-1], -1)
        neighbours = jnp.where(jnp.take_along_axis(inside, chosen, axis=-1), chosen, own)
        return jnp.concatenate([neighbours, jnp.broadcast_to(own, (*own.shape[:-1], max(k - N, 0)))], axis=-1)

    rows = jnp.broadcast_to(column[:, None], (*points.shape[:-1], 1))
    return map_rows(block, rows, compute.rows)


def top_k(x: Array, k: int) -> Array:
    """Return the indices `[B, ..., k]` of the k largest of each row of `x [B, ..., N]`, largest first.

    Under the mesh of several devices (`jax.sharding.use_abstract_mesh`) each device sorts its own rows; XLA alone gathers all rows on
    all devices.
    """
    mesh = jax.sharding.get_abstract_mesh()

    def own_rows(x: Array) -> Array:
        return jax.lax.top_k(x, k)[1]

    if mesh.size == 1 or mesh.empty:
        return own_rows(x)
    rows = PartitionSpec(mesh.axis_names)
    return jax.shard_map(own_rows, mesh=mesh, in_specs=rows, out_specs=rows)(x)


def nearest(query: Array, points: Array, rows: int = 0) -> tuple[Array, Array]:
    """Return index `[..., N]` and distance `[..., N]` of the point of `points [..., M, C]` nearest to each of `query [..., N, C]`.

    The distance is treated as a constant: it has no derivative.
    """
    query, points = jax.lax.stop_gradient((query, points))

    def block(q: Array) -> tuple[Array, Array]:
        square = squared_distances(q, points)
        return jnp.argmin(square, axis=-1), jnp.sqrt(jnp.min(square, axis=-1))

    return map_rows(block, query, rows)
