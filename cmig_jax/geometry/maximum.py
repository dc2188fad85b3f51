"""The maximum along an axis, with a derivative that survives compilation."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def maximum(x: Array, axis: int) -> Array:
    """Return the maximum of `x` along `axis`; its derivative goes to the first position that has it.

    JAX's own finds that position by comparing `x` with its maximum. A compiler that computes `x` twice, once for the maximum and
    once for the comparison, and rounds the two differently (a fused multiply-add in one) finds none, and the derivative is lost.
    """
    return jnp.max(x, axis=axis)


@maximum.defjvp
def _maximum_jvp(axis: int, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (x,), (tangent,) = primals, tangents
    position = jnp.argmax(x, axis=axis, keepdims=True)
    return maximum(x, axis), jnp.take_along_axis(tangent, position, axis=axis).squeeze(axis)
