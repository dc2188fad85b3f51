"""Loops over chunks of an axis, so that only one chunk of a large intermediate result exists at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

T = TypeVar("T")


def chunk_length(length: int, most: int) -> int:
    """Return the length of equal chunks, at most `most`, of which the fewest cover an axis; the last chunk may need padding."""
    number = -(-length // max(1, most))
    return -(-length // number)


def split(x: Array, axis: int, size: int) -> Array:
    """Split an axis into chunks of `size`, padded with zeros at the end, along a new first axis: `[n, ..., size, ...]`."""
    axis %= x.ndim
    pad = [(0, 0)] * x.ndim
    pad[axis] = (0, -x.shape[axis] % size)
    padded = jnp.pad(x, pad) if any(after for _, after in pad) else x
    return jnp.moveaxis(padded.reshape(*x.shape[:axis], -1, size, *x.shape[axis + 1 :]), axis, 0)


def join(chunks: Array, axis: int, length: int) -> Array:
    """Undo `split` for an axis of the given length."""
    moved = jnp.moveaxis(chunks, 0, axis)
    joined = moved.reshape(*moved.shape[:axis], -1, *moved.shape[axis + 2 :])
    return joined if joined.shape[axis] == length else jax.lax.slice_in_dim(joined, 0, length, axis=axis)


def map_rows(function: Callable[[Array], T], x: Array, rows: int) -> T:
    """Apply `function` to chunks of at most `rows` rows of `x [..., N, C]` and join the results `[..., N, ...]` (0: all rows at once).

    The results must have the leading axes of `x` and then its rows. Chunks run one after another.
    """
    N, axis = x.shape[-2], x.ndim - 2
    if rows == 0 or rows >= N:
        return function(x)
    results = jax.lax.map(function, split(x, axis, chunk_length(N, rows)))
    return jax.tree.map(lambda chunks: join(chunks, axis, N), results)
