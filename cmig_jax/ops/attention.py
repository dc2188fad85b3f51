"""Scaled dot-product attention."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.ops.chunks import map_rows
from cmig_jax.ops.kernels import is_fast


def attend(query: Array, key: Array, value: Array, compute: ComputeConfig) -> Array:
    """Return `softmax(Q K^T / sqrt(C)) V`.

    Args:
        query: `[..., N, C]`.
        key, value: `[..., M, C]`.
        compute: `kernels`, and `rows`, the queries per chunk.

    Returns:
        `[..., N, C]`.
    """
    attend_to_all = _attend if is_fast(compute.kernels) else _plain

    def one_chunk(q: Array) -> Array:
        return attend_to_all(q, key, value)

    if 0 < compute.rows < query.shape[-2]:  # the derivative computes each chunk's weights again instead of keeping them all
        one_chunk = jax.checkpoint(one_chunk)
    return map_rows(one_chunk, query, compute.rows)


def _plain(query: Array, key: Array, value: Array) -> Array:
    return jnp.einsum("...nm,...mc->...nc", _weights(query, key).astype(value.dtype), value)


def _weights(query: Array, key: Array) -> Array:
    scores = jnp.einsum("...nc,...mc->...nm", query, key).astype(jnp.promote_types(query.dtype, jnp.float32))
    return jax.nn.softmax(scores / query.shape[-1] ** 0.5, axis=-1)


_attend = jax.custom_vjp(_plain)


def _attend_forward(query: Array, key: Array, value: Array) -> tuple[Array, tuple[Array, ...]]:
    weights = _weights(query, key).astype(value.dtype)
    attended = jnp.einsum("...nm,...mc->...nc", weights, value)
    return attended, (query, key, value, weights, attended)


def _attend_backward(saved: tuple[Array, ...], gradient: Array) -> tuple[Array, Array, Array]:
    """XLA's own derivative of batched attention takes three times as long on a CPU."""
    query, key, value, weights, attended = saved
    wide = jnp.promote_types(query.dtype, jnp.float32)
    of_weights = jnp.einsum("...nc,...mc->...nm", gradient, value).astype(wide)
    mean = jnp.sum((gradient * attended).astype(wide), axis=-1, keepdims=True)
    of_scores = (weights.astype(wide) * (of_weights - mean) / query.shape[-1] ** 0.5).astype(query.dtype)
    return (
        jnp.einsum("...nm,...mc->...nc", of_scores, key),
        jnp.einsum("...nm,...nc->...mc", of_scores, query),
        jnp.einsum("...nm,...nc->...mc", weights, gradient),
    )


_attend.defvjp(_attend_forward, _attend_backward)
