"""The stem's maximum over windows (3 x 3, stride 2, padding 1), with a derivative that a CPU computes as fast as the maximum itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


@jax.custom_vjp
def max_pool(x: Array) -> Array:
    """Return the maximum over windows of 3 x 3 at every second pixel: `[B, H, W, C]` to `[B, ceil(H / 2), ceil(W / 2), C]`.

    The derivative goes to the first pixel of a window, row by row, that has the maximum. JAX's own sorts out positions one by one.
    """
    return _max_pool_forward(x)[0]


def _max_pool_forward(x: Array) -> tuple[Array, tuple[Array, tuple[int, int]]]:
    height, width = x.shape[1:3]
    padded = jnp.pad(x, ((0, 0), (1, 1 + height % 2), (1, 1 + width % 2), (0, 0)), constant_values=-jnp.inf)
    rows, columns = -(-height // 2), -(-width // 2)
    best, place = None, jnp.zeros((), jnp.uint8)
    for i in range(3):
        for j in range(3):
            candidate = padded[:, i : i + 2 * rows - 1 : 2, j : j + 2 * columns - 1 : 2]
            if best is None:
                best, place = candidate, jnp.zeros(candidate.shape, jnp.uint8)
            else:
                place = jnp.where(candidate > best, jnp.uint8(3 * i + j), place)
                best = jnp.maximum(best, candidate)
    assert best is not None
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

    # XLA would choose among the phases anew for every number; made first, they are only copied to their pixels.
    phases = jax.lax.optimization_barrier([[phase(row, column) for column in (0, 1)] for row in (0, 1)])
    whole = jnp.stack([jnp.stack(pair, axis=3) for pair in phases], axis=2)
    return (whole.reshape(B, 2 * rows, 2 * columns, C)[:, :height, :width],)


max_pool.defvjp(_max_pool_forward, _max_pool_backward)
