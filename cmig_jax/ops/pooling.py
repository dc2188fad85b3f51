"""Maxima: over an axis, and over the windows of the image encoder's stem (3 x 3, stride 2, padding 1)."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import Kernels
from cmig_jax.ops.kernels import is_fast


def maximum(x: Array, axis: int, kernels: Kernels = "auto") -> Array:
    """Return the maximum of `x` along `axis`; its derivative goes to the first position that has it.

    The derivative of `jnp.max` compares `x` with its maximum; where the compiler rounds two computations of `x` differently (a fused
    multiply-add in one) it finds no position, and is lost.
    """
    return _maximum(x, axis) if is_fast(kernels) else _at_argmax(x, x, axis)


def _at_argmax(x: Array, values: Array, axis: int) -> Array:
    position = jnp.argmax(jax.lax.stop_gradient(x), axis=axis, keepdims=True)
    return jnp.take_along_axis(values, position, axis=axis).squeeze(axis)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _maximum(x: Array, axis: int) -> Array:
    return jnp.max(x, axis=axis)


@_maximum.defjvp
def _maximum_jvp(axis: int, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (tangent,) = primals, tangents
    return _maximum(x, axis), _at_argmax(x, tangent, axis)


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def selected_maximum(x: Array, axis: int) -> Array:
    """Return `maximum(x, axis)`, faster to differentiate where `axis` is short.

    Its derivative selects among all values. That of `maximum` scatters one number for each of the results, one after another.
    """
    return jnp.max(x, axis=axis)


@selected_maximum.defjvp
def _selected_maximum_jvp(axis: int, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (tangent,) = primals, tangents
    position = jnp.argmax(jax.lax.stop_gradient(x), axis=axis, keepdims=True)
    chosen = jax.lax.broadcasted_iota(position.dtype, x.shape, axis) == position
    return selected_maximum(x, axis), jnp.sum(jnp.where(chosen, tangent, 0), axis=axis)


def max_pool(x: Array, kernels: Kernels = "auto") -> Array:
    """Return the maximum over windows of 3 x 3 around every second pixel: `[B, H, W, C]` to `[B, ceil(H / 2), ceil(W / 2), C]`.

    Of equal values the derivative goes to the first in the window, row by row.
    """
    if is_fast(kernels):
        return _max_pool(x)
    padding = ((0, 0), (1, 1), (1, 1), (0, 0))
    return jax.lax.reduce_window(x, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), padding)


@jax.custom_vjp
def _max_pool(x: Array) -> Array:
    return _max_pool_forward(x)[0]


def _max_pool_forward(x: Array) -> tuple[Array, tuple[Array, tuple[int, int]]]:
    height, width = x.shape[1:3]
    padded = jnp.pad(x, ((0, 0), (1, 1 + height % 2), (1, 1 + width % 2), (0, 0)), constant_values=-jnp.inf)
    rows, columns = -(-height // 2), -(-width // 2)
    shifted = [padded[:, i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2] for i in range(3) for j in range(3)]
    best, place = shifted[0], jnp.zeros(shifted[0].shape, jnp.uint8)
    for number, candidate in enumerate(shifted[1:], 1):
        place = jnp.where(candidate > best, jnp.uint8(number), place)
        best = jnp.maximum(best, candidate)
    return best, (place, (height, width))


def _max_pool_backward(saved: tuple[Array, tuple[int, int]], gradient: Array) -> tuple[Array]:
    """Give each pixel what its windows send: an even row is the middle of one window, an odd row the last of one and first of the next."""
    place, (height, width) = saved
    B, rows, columns, C = gradient.shape
    none, edge = jnp.uint8(9), ((0, 0), (0, 1), (0, 1), (0, 0))
    place, gradient = jnp.pad(place, edge, constant_values=none), jnp.pad(gradient, edge)
    windows = {0: ((1, 0),), 1: ((2, 0), (0, 1))}  # parity of a pixel: (its place in a window, which window)

    def sent(i: int, j: int, down: int, right: int) -> Array:
        there = (slice(None), slice(down, down + rows), slice(right, right + columns))
        return jnp.where(place[there] == 3 * i + j, gradient[there], 0)

    def phase(odd_row: int, odd_column: int) -> Array:
        parts = [sent(i, j, down, right) for i, down in windows[odd_row] for j, right in windows[odd_column]]
        return sum(parts[1:], parts[0])

    # Without the barrier XLA selects among the four phases again for every element.
    phases = jax.lax.optimization_barrier([[phase(row, column) for column in (0, 1)] for row in (0, 1)])
    whole = jnp.stack([jnp.stack(pair, axis=3) for pair in phases], axis=2)
    return (whole.reshape(B, 2 * rows, 2 * columns, C)[:, :height, :width],)


_max_pool.defvjp(_max_pool_forward, _max_pool_backward)
