"""Networks over all pairs of keypoints, which hold a layer's activations once, and the first layer's never.

The first layer is a sum of `S_ij * (a_i + b_j)` with few S (`PairSum`): its batch statistics follow from sums and products over
points, and its values are made where they are read. Later layers go through the pairs chunk by chunk (rows of source keypoints),
small enough to stay in the processor's cache; normalisation and ReLU are done by the layer that reads. The derivative walks the same
chunks and computes again what it needs of each (`sweep`). In evaluation, where statistics are known, one walk does all layers.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.geometry.maximum import maximum
from cmig_jax.nn.mlp import Weights
from cmig_jax.nn.norm import Affine, BatchNorm, Moments, channels, moments

HIGHEST = jax.lax.Precision.HIGHEST
# Pairs per chunk: a CPU's cache holds as many with 256 channels; an accelerator wants large kernels.
PAIRS_AT_A_TIME = {"cpu": 4096}
PAIRS_ON_ACCELERATORS = 2**20


@struct.dataclass
class PairTerm:
    """Values over pairs, `scale_ij * (row_i + column_j)`: `[B, N, M]`, `[B, N, C]` or None for 0, `[B, M, C]` or `[1, 1, C]`."""

    scale: Array
    row: Array | None
    column: Array

    def times(self, factor: Array) -> PairTerm:
        """Multiply the channels by `factor [C]`."""
        factor = factor[None, None, :]
        return PairTerm(self.scale, None if self.row is None else self.row * factor, self.column * factor)


@struct.dataclass
class PairSum:
    """Values over pairs: `row_i` `[B, N, C]` and terms."""

    row: Array
    terms: tuple[PairTerm, ...]

    def __add__(self, other: PairSum) -> PairSum:
        return PairSum(self.row + other.row, self.terms + other.terms)

    def values(self) -> Array:
        """Return `[B, N, M, C]`."""
        total = self.row[:, :, None]
        for t in self.terms:
            column = t.column[:, None]
            total = total + t.scale[..., None] * (column if t.row is None else column + t.row[:, :, None])
        return total

    def moments(self) -> Moments:
        """Take mean and variance per channel from sums over points; everything is centred first, so that squares keep their digits."""
        B, N, M = self.terms[0].scale.shape
        row, column, terms = self.row, jnp.zeros((B, M, self.row.shape[-1]), self.row.dtype), []
        for t in self.terms:
            a, b = jnp.zeros_like(row) if t.row is None else t.row, jnp.broadcast_to(t.column, column.shape)
            middle = jnp.mean(t.scale)
            row, column = row + middle * a, column + middle * b
            terms.append((t.scale - middle, a, b))
        means = [jnp.mean(x, axis=(0, 1), keepdims=True) for x in (row, column)]
        terms.append((jnp.ones((B, N, M), row.dtype), row - means[0], column - means[1]))
        first, second = jnp.zeros_like(row[0, 0]), jnp.zeros_like(row[0, 0])
        for scale, a, b in terms:
            first += _weighted(scale, a, b)
            for other, c, d in terms:
                product = scale * other
                mixed = jnp.einsum("bnm,bmc->bnc", product, d, precision=HIGHEST)
                second += _weighted(product, a * c, b * d) + 2 * jnp.sum(a * mixed, axis=(0, 1))
        mean, count = first / (B * N * M), B * N * M
        return Moments(mean=mean + (means[0] + means[1])[0, 0], variance=second / count - mean**2, count=count)

    def normalised(self, affine: Affine) -> PairSum:
        """Apply what BatchNorm does to a channel."""
        return PairSum(affine(self.row), tuple(t.times(affine.scale) for t in self.terms))


def _weighted(weight: Array, row: Array, column: Array) -> Array:
    """Sum `weight_ij (row_i + column_j)` over pairs, `[C]`."""
    of_row, of_column = jnp.sum(weight, axis=2)[..., None], jnp.sum(weight, axis=1)[..., None]
    return jnp.sum(of_row * row, axis=(0, 1)) + jnp.sum(of_column * column, axis=(0, 1))


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
        pairs = pairs.normalised(BatchNorm(self.widths[0], name="first_norm").affine(pairs.moments() if train else None))
        dtype = self.dtype or wide
        first, chunks = _chunked(pairs, self.rows)
        layers = Hidden(self.widths, dtype, name="hidden")(first, chunks, train=train)
        kernel, bias = Weights(self.widths[-1], 1, name="last")()
        assert bias is not None

        def last(shared: Any, chunk: Any) -> tuple[Array, Array | None]:
            hidden = _hidden(shared[0], chunk, dtype)
            similarity = (hidden @ shared[1].astype(dtype))[..., 0].astype(wide) + channels(shared[2], 3)
            return similarity, maximum(hidden, 2).astype(wide) if self.pooled else None

        similarity, pooled = sweep(last, (layers[0], kernel, bias), layers[1])
        return joined(similarity), None if pooled is None else joined(pooled)


class Hidden(nn.Module):
    """Layers of linear (no bias), BatchNorm, ReLU over pairs."""

    widths: tuple[int, ...]
    dtype: jnp.dtype

    @nn.compact
    def __call__(self, first: PairSum, chunks: Any, *, train: bool) -> tuple[Any, Any]:
        """Return what `_hidden` makes the last layer from: in training the last linear layer's values, in evaluation all weights."""
        shared, dtype = (first, ()), self.dtype

        def linear(shared: Any, chunk: Any) -> tuple[Array, Moments]:
            y = _hidden(shared[0], chunk, dtype) @ shared[1].astype(dtype)
            return y, moments([y])

        for i, (inputs, width) in enumerate(zip(self.widths[:-1], self.widths[1:], strict=True)):
            kernel, norm = Weights(inputs, width, use_bias=False, name=f"layer_{i}")()[0], BatchNorm(width, name=f"norm_{i}")
            if train:
                chunks, parts = sweep(linear, (shared, kernel), chunks)
                shared = (None, ((None, norm.affine(_together(parts))),))
            else:
                shared = (shared[0], (*shared[1], (kernel, norm.affine(None))))
        return shared, chunks


def _hidden(shared: Any, chunk: Any, dtype: jnp.dtype) -> Array:
    """Make a hidden layer of a chunk: from the first layer's terms or a later one's values, through the layers in `shared`."""
    columns, layers = shared
    x = chunk if columns is None else nn.relu(_values(chunk, columns)).astype(dtype)
    for kernel, affine in layers:
        x = nn.relu(affine(x if kernel is None else x @ kernel.astype(dtype)))
    return x


def _chunked(pairs: PairSum, rows: int) -> tuple[Any, Any]:
    """Split a sum into what belongs to columns and chunks of what belongs to rows."""
    B, N, M = pairs.terms[0].scale.shape
    split = chunks_of(B, N, M, rows)
    columns = tuple(t.column for t in pairs.terms)
    return columns, (split(pairs.row), tuple((split(t.scale), None if t.row is None else split(t.row)) for t in pairs.terms))


def _values(chunk: Any, columns: Any) -> Array:
    row, terms = chunk
    return PairSum(row, tuple(PairTerm(s, a, b) for (s, a), b in zip(terms, columns, strict=True))).values()


def chunks_of(B: int, N: int, M: int, rows: int) -> Callable[[Array], Array]:
    """Return how to split `[B, N, ...]` into chunks `[N / R, B, R, ...]`: R rows (0: as many as suit the machine) that divide N."""
    at_a_time = PAIRS_AT_A_TIME.get(jax.default_backend(), PAIRS_ON_ACCELERATORS)
    most = rows or max(1, at_a_time // (B * M))
    R = max(r for r in range(1, min(most, N) + 1) if N % r == 0)
    return lambda x: x.reshape(B, N // R, R, *x.shape[2:]).swapaxes(0, 1)


def joined(chunks: Array) -> Array:
    """Undo `chunks_of`: `[n, B, R, ...]` to `[B, n R, ...]`."""
    n, B, R = chunks.shape[:3]
    return chunks.swapaxes(0, 1).reshape(B, n * R, *chunks.shape[3:])


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
