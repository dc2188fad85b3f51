"""The maximum over targets of a linear layer on two similarities: what the credibility of a source keypoint is computed from."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.ops.chunks import join, split
from cmig_jax.ops.kernels import is_fast
from cmig_jax.ops.moments import channels
from cmig_jax.ops.pair_loops import rows_per_chunk
from cmig_jax.ops.pooling import maximum


def best_target(kernel: Array, bias: Array, feature: Array, coordinate: Array, compute: ComputeConfig) -> Array:
    """Apply a linear layer to each pair's two similarities, and take the maximum over targets.

    Args:
        kernel: `[2, C]`.
        bias: `[C]`.
        feature, coordinate: `[B, N, M]`.
        compute: `kernels`, and `rows`, the source keypoints per chunk.

    Returns:
        `[B, N, C]`.
    """
    largest = _largest if is_fast(compute.kernels) else _plain_largest
    return largest(kernel, feature, coordinate, compute.rows) + channels(bias, 3)


def _plain_largest(kernel: Array, feature: Array, coordinate: Array, rows: int) -> Array:
    del rows
    return maximum(_weighted(kernel, feature, coordinate), 2, "plain")


def _weighted(kernel: Array, feature: Array, coordinate: Array) -> Array:
    return feature[..., None] * channels(kernel[0], 4) + coordinate[..., None] * channels(kernel[1], 4)


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _largest(kernel: Array, feature: Array, coordinate: Array, rows: int) -> Array:
    """Return the maximum over targets of `kernel[0] feature_ij + kernel[1] coordinate_ij`, without its values at all pairs."""
    return _over_targets(jnp.max, kernel, feature, coordinate, rows)


@_largest.defjvp
def _largest_jvp(rows: int, primals: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    """Differentiate only the pairs that have the maximum."""
    kernel, feature, coordinate = primals
    index = _over_targets(jnp.argmax, kernel, feature, coordinate, rows)

    def at_best(kernel: Array, feature: Array, coordinate: Array) -> Array:
        own, other = (jnp.take_along_axis(x, index, axis=2) for x in (feature, coordinate))
        return own * channels(kernel[0], 3) + other * channels(kernel[1], 3)

    return jax.jvp(at_best, primals, tangents)


def _over_targets(reduce: Callable[..., Array], kernel: Array, feature: Array, coordinate: Array, rows: int) -> Array:
    """Reduce `kernel[0] feature_ij + kernel[1] coordinate_ij`, `[B, N, M, C]`, over M, a chunk of rows at a time."""
    N = feature.shape[1]
    R = rows_per_chunk(feature.shape, kernel.shape[-1], rows)
    chunks = split(feature, 1, R), split(coordinate, 1, R)
    return join(jax.lax.map(lambda chunk: reduce(_weighted(kernel, *chunk), axis=2), chunks), 1, N)
