"""Reductions over the edges of a neighbour graph: maximum and statistics of `p_j + q_i` (j a neighbour of i), for EdgeConv."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig, Kernels
from cmig_jax.ops.chunks import chunk_length, split
from cmig_jax.ops.kernels import is_fast
from cmig_jax.ops.moments import Moments, moments
from cmig_jax.ops.pooling import maximum


def gather(x: Array, index: Array) -> Array:
    """Return `[B, ..., C]`, the rows of `x [B, M, C]` that `index [B, ...]` names; of a graph, `[B, N, k]`."""
    return jax.vmap(lambda rows, i: rows[i])(x, index)


def neighbour_maximum(x: Array, neighbours: Array, kernels: Kernels = "auto") -> Array:
    """Return the maximum of `x [B, N, C]` over the neighbours `[B, N, k]` of each point, per channel: `[B, N, C]`.

    The fast derivative goes to the neighbour that has the maximum (the nearest of equal ones): it scatters one number per point and
    channel, where the derivative of a gather scatters one per edge.
    """
    return _neighbour_maximum(x, neighbours) if is_fast(kernels) else maximum(gather(x, neighbours), 2, "plain")


@jax.custom_vjp
def _neighbour_maximum(x: Array, neighbours: Array) -> Array:
    return _maximum_and_source(x, neighbours)[0]


def _maximum_and_source(x: Array, neighbours: Array) -> tuple[Array, Array]:
    def visit(best: tuple[Array, Array], index: Array) -> tuple[tuple[Array, Array], None]:
        value, source = best
        candidate = jnp.take_along_axis(x, index[..., None], axis=1)
        better = candidate > value
        return (jnp.where(better, candidate, value), jnp.where(better, index[..., None], source)), None

    start = jnp.full_like(x, -jnp.inf), jnp.broadcast_to(neighbours[..., :1], x.shape)
    return jax.lax.scan(visit, start, jnp.moveaxis(neighbours, -1, 0), unroll=True)[0]


def _neighbour_maximum_backward(source: Array, gradient: Array) -> tuple[Array, None]:
    channel = jnp.arange(gradient.shape[-1])[None, :]
    scatter = jax.vmap(lambda g, s: jnp.zeros_like(g).at[s, channel].add(g))
    return scatter(gradient, source), None


_neighbour_maximum.defvjp(_maximum_and_source, _neighbour_maximum_backward)


def edge_moments(neighbour: tuple[Array, ...], centre: tuple[Array, ...], index: tuple[Array, ...], compute: ComputeConfig) -> Moments:
    """Return the statistics of `p_j + q_i` over all edges of several clouds.

    Args:
        neighbour: of each cloud p, `[B, N_c, C]`.
        centre: of each cloud q, `[B, N_c, C]`.
        index: of each cloud the neighbours j of i, `[B, N_c, k]`.
        compute: `kernels`, and `rows`, the points i per chunk.
    """
    if not is_fast(compute.kernels):
        edges = [gather(p, i) + q[:, :, None] for p, q, i in zip(neighbour, centre, index, strict=True)]
        return moments(edges, "plain")
    count = index[0].shape[-1] * sum(p.shape[0] * p.shape[1] for p in neighbour)
    sums = [_edge_sums(p, q, i, compute.rows) for p, q, i in zip(neighbour, centre, index, strict=True)]
    first, second = (jnp.sum(jnp.stack(parts), axis=0) for parts in zip(*sums, strict=True))
    mean = first / count
    return Moments(mean=mean, variance=second / count - mean**2, count=count)


def _edge_sums(p: Array, q: Array, index: Array, rows: int) -> tuple[Array, Array]:
    """Sum `p_j + q_i` and its square over the edges of a cloud, `[C]` each, from sums over points: p by in-degree, p_j q_i by adjacency."""
    N, k = index.shape[1:]
    if rows == 0 or rows >= N:
        degree, summed_q = _by_adjacency(p, q, index)
    else:

        def visit(total: Array, chunk: tuple[Array, Array]) -> tuple[Array, Array]:
            degree, summed = _by_adjacency(p, *chunk)
            return total + degree, summed

        size = chunk_length(N, rows)
        # Padded rows have q = 0 and indices beyond the points, which the scatter drops.
        beyond = jnp.broadcast_to(N + jnp.arange(k, dtype=index.dtype), (len(index), -N % size, k))
        padded = jnp.concatenate([index, beyond], axis=1)
        start = jnp.zeros((p.shape[0], N, 1), p.dtype)
        # The derivative builds each chunk's adjacency again instead of keeping them all.
        degree, parts = jax.lax.scan(jax.checkpoint(visit), start, (split(q, 1, size), split(padded, 1, size)))
        summed_q = jnp.sum(parts, axis=0)
    first = jnp.sum(degree * p + k * q, axis=(0, 1))
    return first, jnp.sum(degree * p**2 + k * q**2, axis=(0, 1)) + 2 * summed_q


def _by_adjacency(p: Array, q: Array, index: Array) -> tuple[Array, Array]:
    """Return how often each point is a neighbour `[B, N, 1]`, and the sum of `p_j q_i` over edges `[C]`."""
    adjacency = _adjacency(index, p.shape[1], p.dtype)
    summed = jnp.einsum("bnm,bmc->bnc", adjacency, p)
    return jnp.sum(adjacency, axis=1)[..., None], jnp.sum(summed * q, axis=(0, 1))


def _adjacency(index: Array, points: int, dtype: jnp.dtype) -> Array:
    """Return `[B, R, N]`, 1 where the column is a neighbour of the row, from neighbours `[B, R, k]`."""
    rows = jnp.arange(index.shape[1])[:, None]
    scatter = jax.vmap(lambda i: jnp.zeros((index.shape[1], points), dtype).at[rows, i].set(1, mode="drop", unique_indices=True))
    return scatter(index)
