"""Layers over all pairs of keypoints: normalisation, ReLU and a matrix, several times, then one number per pair.

`first_layer` starts from a `PairSum` and returns an object that the network takes through its layers:

    values = first_layer(pairs, width, compute)             # [B, N, M, C] before normalisation
    affine = norm.affine(values.moments() if train else None)
    values = values.then(affine, kernel)                    # relu(affine(values)) @ kernel
    similarity, pooled = values.last(affine, kernel, bias)  # [B, N, M]

`Whole` is the plain version. The fast one goes through chunks of source keypoints that fit a CPU's cache. Where moments are asked for (in
training), it stores a layer's values before their normalisation; normalisation and ReLU are computed by the layer that reads them, and
again by the derivative. Where none are asked for, one loop computes all layers.
"""

from __future__ import annotations

import functools
from typing import Any, Protocol

import jax
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.ops.chunks import join, split
from cmig_jax.ops.kernels import is_fast
from cmig_jax.ops.moments import Affine, Moments, channels, moments
from cmig_jax.ops.pair_loops import Layer, linear, loop, rows_per_chunk
from cmig_jax.ops.pairs import PairSum, PairTerm, fast_moments, fast_values, plain_values
from cmig_jax.ops.pooling import maximum


class PairValues(Protocol):
    """Values over pairs `[B, N, M, C]`, before their normalisation."""

    def moments(self) -> Moments:
        """Return their batch statistics."""
        ...

    def then(self, affine: Affine, kernel: Array) -> PairValues:
        """Return `relu(affine(values)) @ kernel`, computed in the type of `kernel [C, C']`."""
        ...

    def last(self, affine: Affine, kernel: Array, bias: Array, pooled: bool) -> tuple[Array, Array | None]:
        """Return `relu(affine(values)) @ kernel + bias` for `kernel [C, 1]`, as `[B, N, M]`, and the maximum of `relu(affine(values))`
        over targets, `[B, N, C]`, if `pooled`."""
        ...


def first_layer(pairs: PairSum, width: int, compute: ComputeConfig) -> PairValues:
    """Start from the first layer's values; `width` is the largest number of channels of all layers."""
    if not is_fast(compute.kernels):
        return Whole(plain_values(pairs), pairs.row.dtype)
    return _FirstChunked(pairs, width, compute.rows)


class Whole:
    """The plain version: all values at once, JAX's own derivative."""

    def __init__(self, values: Array, wide: Any) -> None:
        self.values, self.wide = values, wide

    def moments(self) -> Moments:
        return moments([self.values], "plain")

    def then(self, affine: Affine, kernel: Array) -> Whole:
        return Whole(self._hidden(affine, kernel) @ kernel, self.wide)

    def last(self, affine: Affine, kernel: Array, bias: Array, pooled: bool) -> tuple[Array, Array | None]:
        hidden = self._hidden(affine, kernel)
        similarity = (hidden @ kernel)[..., 0].astype(self.wide) + channels(bias, 3)
        return similarity, maximum(hidden, 2, "plain").astype(self.wide) if pooled else None

    def _hidden(self, affine: Affine, kernel: Array) -> Array:
        return jax.nn.relu(affine(self.values)).astype(kernel.dtype)


class _FirstChunked:
    """The first layer of the fast version; its values are never stored."""

    def __init__(self, pairs: PairSum, width: int, rows: int) -> None:
        self.pairs, self.width, self.rows = pairs, width, rows

    def moments(self) -> Moments:
        return fast_moments(self.pairs)

    def then(self, affine: Affine, kernel: Array) -> _Chunked:
        return _Chunked(*self._normalised(affine), kernel, *self._size())

    def last(self, affine: Affine, kernel: Array, bias: Array, pooled: bool) -> tuple[Array, Array | None]:
        return _last(*self._normalised(affine), kernel, bias, pooled, self.pairs.row.shape[1])

    def _normalised(self, affine: Affine) -> tuple[Layer, Any, Any]:
        pairs = self.pairs.scale_about(affine.mean, affine.scale, affine.bias)
        R = rows_per_chunk(pairs.terms[0].scale.shape, self.width, self.rows)
        columns = tuple(t.column for t in pairs.terms)
        terms = tuple((split(t.scale, 1, R), None if t.row is None else split(t.row, 1, R)) for t in pairs.terms)
        return _first, columns, (split(pairs.row, 1, R), terms)

    def _size(self) -> tuple[int, int]:
        B, N, M = self.pairs.terms[0].scale.shape
        return N, B * N * M


class _Chunked:
    """A later layer of the fast version: `relu(layer(shared, chunk)) @ kernel`, stored once its moments are asked for."""

    def __init__(self, layer: Layer, shared: Any, chunks: Any, kernel: Array, N: int, count: int) -> None:
        self.layer, self.shared, self.chunks, self.kernel, self.N, self.count = layer, shared, chunks, kernel, N, count
        self.stored: Array | None = None

    def moments(self) -> Moments:
        self.stored, parts = linear(self.layer, self.shared, self.chunks, self.kernel, self.N, self.count)
        return parts

    def then(self, affine: Affine, kernel: Array) -> _Chunked:
        return _Chunked(*self._normalised(affine), kernel, self.N, self.count)

    def last(self, affine: Affine, kernel: Array, bias: Array, pooled: bool) -> tuple[Array, Array | None]:
        return _last(*self._normalised(affine), kernel, bias, pooled, self.N)

    def _normalised(self, affine: Affine) -> tuple[Layer, Any, Any]:
        if self.stored is not None:
            return _affine, affine, self.stored
        return functools.partial(_next, self.layer), (self.shared, self.kernel, affine), self.chunks


def _first(columns: Any, chunk: Any) -> Array:
    row, terms = chunk
    return fast_values(PairSum(row, tuple(PairTerm(s, a, b) for (s, a), b in zip(terms, columns, strict=True))))


def _affine(affine: Affine, chunk: Array) -> Array:
    return affine(chunk)


def _next(layer: Layer, shared: Any, chunk: Any) -> Array:
    before, kernel, affine = shared
    return affine(jax.nn.relu(layer(before, chunk)).astype(kernel.dtype) @ kernel)


def _last(layer: Layer, shared: Any, chunks: Any, kernel: Array, bias: Array, pooled: bool, N: int) -> tuple[Array, Array | None]:
    wide = bias.dtype

    def visit(shared: Any, chunk: Any) -> tuple[Array, Array | None]:
        before, kernel, bias = shared
        hidden = jax.nn.relu(layer(before, chunk)).astype(kernel.dtype)
        similarity = (hidden @ kernel)[..., 0].astype(wide) + channels(bias, 3)
        return similarity, maximum(hidden, 2, "fast").astype(wide) if pooled else None

    similarity, largest = loop(visit, (shared, kernel, bias), chunks)
    return join(similarity, 1, N), None if largest is None else join(largest, 1, N)
