"""Networks over all pairs of keypoints, which hold a layer's values once and the first layer's never (Sec. III-E, Fig. 5).

Layers go through the pairs chunk by chunk (rows of source keypoints), small enough to stay in the processor's cache. In training a
layer's values are stored before their normalisation; normalisation and ReLU are done by the layer that reads, and again by the
derivative, which walks the same chunks. In evaluation, where statistics are known, one walk does all layers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.geometry.maximum import maximum
from cmig_jax.nn.mlp import Weights
from cmig_jax.nn.norm import Affine, BatchNorm, Moments, channels, moments
from cmig_jax.nn.pairs import PairSum, PairTerm

# Numbers per chunk: what a CPU's cache holds; an accelerator wants large kernels.
NUMBERS_AT_A_TIME = {"cpu": 2**21}
NUMBERS_ON_ACCELERATORS = 2**28

# (shared, chunk) -> a hidden layer's values before their ReLU, `[B, R, M, C]`
Layer = Callable[[Any, Any], Array]


class Tower(nn.Module):
    """What follows the first layer: BatchNorm and ReLU, more such layers, and one number per pair.

    `pooled` also returns the last hidden layer's maximum over targets.
    """

    widths: tuple[int, ...]
    rows: int = 0
    pooled: bool = False
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, pairs: PairSum, *, train: bool) -> tuple[Array, Array | None]:
        """Map pairs of `widths[0]` channels to similarities `[B, N, M]` and, if wanted, `[B, N, widths[-1]]`."""
        wide = pairs.row.dtype
        dtype = self.dtype or wide
        pairs = pairs.normalised(BatchNorm(self.widths[0], name="first_norm").affine(pairs.moments() if train else None))
        columns, chunks = _chunked(pairs, max(self.widths), self.rows)
        layer, shared, chunks = Hidden(self.widths, dtype, name="hidden")(columns, chunks, train=train)
        kernel, bias = Weights(self.widths[-1], 1, name="last")()
        assert bias is not None

        def last(shared: Any, chunk: Any) -> tuple[Array, Array | None]:
            hidden = nn.relu(layer(shared[0], chunk)).astype(dtype)
            similarity = (hidden @ shared[1].astype(dtype))[..., 0].astype(wide) + channels(shared[2], 3)
            return similarity, maximum(hidden, 2).astype(wide) if self.pooled else None

        similarity, pooled = sweep(last, (shared, kernel, bias), chunks)
        return joined(similarity), None if pooled is None else joined(pooled)


class Hidden(nn.Module):
    """Layers of linear (no bias), BatchNorm, ReLU over pairs."""

    widths: tuple[int, ...]
    dtype: jnp.dtype

    @nn.compact
    def __call__(self, columns: Any, chunks: Any, *, train: bool) -> tuple[Layer, Any, Any]:
        """Return the last hidden layer, what its chunks share, and its chunks: stored values in training, else the first layer's."""
        layer, shared, layers = _first, columns, []
        for i, (inputs, width) in enumerate(zip(self.widths[:-1], self.widths[1:], strict=True)):
            kernel, norm = Weights(inputs, width, use_bias=False, name=f"layer_{i}")()[0], BatchNorm(width, name=f"norm_{i}")
            if train:
                chunks, batch = linear(layer, shared, chunks, kernel.astype(self.dtype))
                layer, shared = _normalised, norm.affine(batch)
            else:
                layers.append((kernel.astype(self.dtype), norm.affine(None)))
        return (layer, shared, chunks) if train else (_all_layers, (columns, layers), chunks)


def _first(columns: Any, chunk: Any) -> Array:
    row, terms = chunk
    return PairSum(row, tuple(PairTerm(s, a, b) for (s, a), b in zip(terms, columns, strict=True))).values()


def _normalised(affine: Affine, chunk: Array) -> Array:
    return affine(chunk)


def _all_layers(shared: Any, chunk: Any) -> Array:
    columns, layers = shared
    x = _first(columns, chunk)
    for kernel, affine in layers:
        x = affine(nn.relu(x).astype(kernel.dtype) @ kernel)
    return x


def _chunked(pairs: PairSum, width: int, rows: int) -> tuple[Any, Any]:
    """Split a sum into what belongs to columns and chunks of what belongs to rows."""
    B, N, M = pairs.terms[0].scale.shape
    split = chunks_of(B, N, M, width, rows)
    columns = tuple(t.column for t in pairs.terms)
    return columns, (split(pairs.row), tuple((split(t.scale), None if t.row is None else split(t.row)) for t in pairs.terms))


def chunks_of(B: int, N: int, M: int, width: int, rows: int) -> Callable[[Array], Array]:
    """Return how to split `[B, N, ...]` into chunks `[N / R, B, R, ...]`: R rows (0: as many as suit the machine) that divide N.

    Args:
        B, N, M: pairs of clouds, rows, columns.
        width: numbers per pair.
        rows: R at most.
    """
    at_a_time = NUMBERS_AT_A_TIME.get(jax.default_backend(), NUMBERS_ON_ACCELERATORS)
    most = rows or max(1, at_a_time // (B * M * width))
    R = max(r for r in range(1, min(most, N) + 1) if N % r == 0)
    return lambda x: x.reshape(B, N // R, R, *x.shape[2:]).swapaxes(0, 1)


def joined(chunks: Array) -> Array:
    """Undo `chunks_of`: `[n, B, R, ...]` to `[B, n R, ...]`."""
    n, B, R = chunks.shape[:3]
    return chunks.swapaxes(0, 1).reshape(B, n * R, *chunks.shape[3:])


def linear(layer: Layer, shared: Any, chunks: Any, kernel: Array) -> tuple[Array, Moments]:
    """Apply ReLU and a matrix to a layer, chunk by chunk.

    The derivative keeps the inputs and the result, so it computes the layer's values again but no product of the forward pass.

    Args:
        layer: pure, and closed over no array.
        shared: arrays that every chunk reads.
        chunks: arrays with a leading axis over chunks.
        kernel: `[C, C']`.

    Returns:
        `[n, B, R, M, C']`, and their statistics.
    """
    return _linear(layer, shared, chunks, kernel)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _linear(layer: Layer, shared: Any, chunks: Any, kernel: Array) -> tuple[Array, Moments]:
    def visit(chunk: Any) -> tuple[Array, Moments]:
        y = nn.relu(layer(shared, chunk)).astype(kernel.dtype) @ kernel
        return y, moments([y])

    y, parts = cast(tuple[Array, Moments], jax.lax.map(visit, chunks))
    return y, _together(parts)


def _linear_forward(layer: Layer, shared: Any, chunks: Any, kernel: Array) -> tuple[tuple[Array, Moments], Any]:
    y, batch = linear(layer, shared, chunks, kernel)
    return (y, batch), (shared, chunks, kernel, y, batch)


def _linear_backward(layer: Layer, saved: Any, gradient: tuple[Array, Moments]) -> tuple[Any, Any, Array]:
    shared, chunks, kernel, y, batch = saved
    of_y, of_batch = gradient
    slope = 2 * of_batch.variance / batch.count
    offset = of_batch.mean / batch.count - slope * batch.mean

    def visit(total: tuple[Any, Array], at: tuple[Any, Array, Array]) -> tuple[Any, Any]:
        chunk, y, of_y = at
        outer = (of_y + (channels(slope, y.ndim) * y + channels(offset, y.ndim))).astype(kernel.dtype)
        x, pull = jax.vjp(layer, shared, chunk)
        # Over one axis: a sum over several would have XLA copy the operand, turned.
        flat = nn.relu(x).astype(kernel.dtype).reshape(-1, kernel.shape[0])
        of_kernel = jnp.einsum("pc,pd->cd", flat, outer.reshape(-1, kernel.shape[1]))
        of_x = jnp.where(x > 0, (outer @ kernel.T).astype(x.dtype), 0)
        of_shared, of_chunk = pull(of_x)
        return jax.tree.map(jnp.add, total, (of_shared, of_kernel)), of_chunk

    start = jax.tree.map(jnp.zeros_like, (shared, kernel))
    (of_shared, of_kernel), of_chunks = jax.lax.scan(visit, start, (chunks, y, of_y))
    return of_shared, of_chunks, of_kernel


_linear.defvjp(_linear_forward, _linear_backward)


def _together(parts: Moments) -> Moments:
    """Join the moments `[n, C]` of equal chunks."""
    mean = jnp.mean(parts.mean, axis=0)
    variance = jnp.mean(parts.variance + (parts.mean - mean[None]) ** 2, axis=0)
    return Moments(mean=mean, variance=variance, count=parts.count * parts.mean.shape[0])


def sweep(function: Callable[[Any, Any], Any], shared: Any, chunks: Any) -> Any:
    """Apply `function(shared, chunk)` to one chunk after another; the derivative keeps the inputs and computes all else again.

    Args:
        function: pure, and closed over no array.
        shared: arrays that every chunk reads.
        chunks: arrays with a leading axis over chunks.
    """
    return _sweep(function, shared, chunks)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _sweep(function: Callable[[Any, Any], Any], shared: Any, chunks: Any) -> Any:
    return jax.lax.map(lambda chunk: function(shared, chunk), chunks)


def _sweep_forward(function: Callable[[Any, Any], Any], shared: Any, chunks: Any) -> tuple[Any, tuple[Any, Any]]:
    return _sweep(function, shared, chunks), (shared, chunks)


def _sweep_backward(function: Callable[[Any, Any], Any], saved: tuple[Any, Any], gradient: Any) -> tuple[Any, Any]:
    shared, chunks = saved

    def visit(total: Any, at: tuple[Any, Any]) -> tuple[Any, Any]:
        chunk, outer = at
        of_shared, of_chunk = jax.vjp(function, shared, chunk)[1](outer)
        return jax.tree.map(jnp.add, total, of_shared), of_chunk

    return jax.lax.scan(visit, jax.tree.map(jnp.zeros_like, shared), (chunks, gradient))


_sweep.defvjp(_sweep_forward, _sweep_backward)
