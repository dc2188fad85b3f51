"""Loops over chunks of pairs, with derivatives that go through the same chunks: what the fast version in `pair_layers.py` is made of."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from cmig_jax.ops.chunks import chunk_length
from cmig_jax.ops.moments import Moments, channels, join_moments, moments

# Numbers per chunk: on a CPU they stay in the cache; an accelerator needs large chunks.
NUMBERS_PER_CHUNK = {"cpu": 2**21}
NUMBERS_ON_ACCELERATORS = 2**28

# (shared arrays, chunk) -> values before their ReLU, `[B, R, M, C]`; closed over no array.
Layer = Callable[[Any, Any], Array]


def rows_per_chunk(shape: tuple[int, ...], width: int, rows: int) -> int:
    """Return the source keypoints per chunk: at most `rows` (0: as many as suit the backend), in chunks of equal length.

    Args:
        shape: (B, N, M), pairs of clouds, rows, columns.
        width: numbers per pair of points.
        rows: upper bound.
    """
    B, N, M = shape
    at_a_time = NUMBERS_PER_CHUNK.get(jax.default_backend(), NUMBERS_ON_ACCELERATORS)
    return chunk_length(N, rows or at_a_time // (B * M * width))


def linear(layer: Layer, shared: Any, chunks: Any, kernel: Array, N: int, count: int) -> tuple[Array, Moments]:
    """Apply ReLU and a matrix to a layer, chunk by chunk.

    The derivative keeps the inputs and the result: it computes the layer's values again, but no product of the forward pass.

    Args:
        layer: closed over no array.
        shared: arrays that every chunk reads.
        chunks: arrays with a leading axis over chunks of R rows.
        kernel: `[C, C']`.
        N: rows of all chunks without padding.
        count: pairs of points without padding.

    Returns:
        `[n, B, R, M, C']`, and their statistics, to which padding does not contribute.
    """
    return _linear(layer, N, count, shared, chunks, kernel)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _linear(layer: Layer, N: int, count: int, shared: Any, chunks: Any, kernel: Array) -> tuple[Array, Moments]:
    valid = _valid_rows(chunks, N)

    def visit(at: tuple[Any, Array | None]) -> tuple[Array, Moments]:
        chunk, valid = at
        y = jax.nn.relu(layer(shared, chunk)).astype(kernel.dtype) @ kernel
        return y, moments([y], "fast") if valid is None else _moments_of(y, valid)

    y, parts = cast(tuple[Array, Moments], jax.lax.map(visit, (chunks, valid)))
    counts = None if valid is None else jnp.sum(valid, axis=1).astype(parts.mean.dtype)
    return y, join_moments(Moments(mean=parts.mean, variance=parts.variance, count=count), counts)


def _linear_forward(layer: Layer, N: int, count: int, shared: Any, chunks: Any, kernel: Array) -> tuple[tuple[Array, Moments], Any]:
    y, batch = linear(layer, shared, chunks, kernel, N, count)
    return (y, batch), (shared, chunks, kernel, y, batch)


def _linear_backward(layer: Layer, N: int, count: int, saved: Any, gradient: tuple[Array, Moments]) -> tuple[Any, Any, Array]:
    del count
    shared, chunks, kernel, y, batch = saved
    of_y, of_batch = gradient
    slope = 2 * of_batch.variance / batch.count
    offset = of_batch.mean / batch.count - slope * batch.mean

    def visit(total: tuple[Any, Array], at: Any) -> tuple[Any, Any]:
        chunk, y, of_y, valid = at
        of_moments = channels(slope, y.ndim) * y + channels(offset, y.ndim)
        outer = (of_y + (of_moments if valid is None else jnp.where(_over_rows(valid), of_moments, 0))).astype(kernel.dtype)
        x, pull = jax.vjp(layer, shared, chunk)
        # Over one axis: for a sum over several, XLA copies the operand with its axes turned.
        flat = jax.nn.relu(x).astype(kernel.dtype).reshape(-1, kernel.shape[0])
        of_kernel = jnp.einsum("pc,pd->cd", flat, outer.reshape(-1, kernel.shape[1]))
        of_x = jnp.where(x > 0, (outer @ kernel.T).astype(x.dtype), 0)
        of_shared, of_chunk = pull(of_x)
        return jax.tree.map(jnp.add, total, (of_shared, of_kernel)), of_chunk

    start = jax.tree.map(jnp.zeros_like, (shared, kernel))
    (of_shared, of_kernel), of_chunks = jax.lax.scan(visit, start, (chunks, y, of_y, _valid_rows(chunks, N)))
    return of_shared, of_chunks, of_kernel


_linear.defvjp(_linear_forward, _linear_backward)


def _valid_rows(chunks: Any, N: int) -> Array | None:
    """Return `[n, R]`, whether a row of a chunk is not padding; None without padding."""
    n, _, R = jax.tree.leaves(chunks)[0].shape[:3]
    return None if n * R == N else jnp.asarray((np.arange(n * R) < N).reshape(n, R))


def _over_rows(valid: Array) -> Array:
    return valid[None, :, None, None]


def _moments_of(y: Array, valid: Array) -> Moments:
    """Return the moments of the valid rows `[R]` of `y [B, R, M, C]`."""
    wide = y.astype(jnp.promote_types(y.dtype, jnp.float32))
    mask, axes = _over_rows(valid), (0, 1, 2)
    share = 1 / (jnp.sum(valid) * (y.size // (y.shape[1] * y.shape[-1]))).astype(wide.dtype)
    mean = jnp.sum(jnp.where(mask, wide, 0), axis=axes) * share
    variance = jnp.sum(jnp.where(mask, (wide - channels(mean, 4)) ** 2, 0), axis=axes) * share
    return Moments(mean=mean, variance=variance, count=y.size // y.shape[-1])


def loop(function: Callable[[Any, Any], Any], shared: Any, chunks: Any) -> Any:
    """Apply `function(shared, chunk)` to one chunk after another; the derivative keeps the inputs and computes all else again.

    Args:
        function: closed over no array.
        shared: arrays that every chunk reads.
        chunks: arrays with a leading axis over chunks.
    """
    return _loop(function, shared, chunks)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _loop(function: Callable[[Any, Any], Any], shared: Any, chunks: Any) -> Any:
    return jax.lax.map(lambda chunk: function(shared, chunk), chunks)


def _loop_forward(function: Callable[[Any, Any], Any], shared: Any, chunks: Any) -> tuple[Any, tuple[Any, Any]]:
    return _loop(function, shared, chunks), (shared, chunks)


def _loop_backward(function: Callable[[Any, Any], Any], saved: tuple[Any, Any], gradient: Any) -> tuple[Any, Any]:
    shared, chunks = saved

    def visit(total: Any, at: tuple[Any, Any]) -> tuple[Any, Any]:
        chunk, outer = at
        of_shared, of_chunk = jax.vjp(function, shared, chunk)[1](outer)
        return jax.tree.map(jnp.add, total, of_shared), of_chunk

    return jax.lax.scan(visit, jax.tree.map(jnp.zeros_like, shared), (chunks, gradient))


_loop.defvjp(_loop_forward, _loop_backward)
