"""Rigid motions from twists: the exponential map of SE(3).

A twist `[..., 6]` is (w, v): an axis times its angle in radians, and a velocity. Its motion takes x to `exp(hat(w)) x + V v`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.transform import RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST
SERIES_BELOW = 0.01  # angle, radians: below it the closed forms lose digits


def hat(w: Array) -> Array:
    """Return the matrices `[..., 3, 3]` of the cross products with `w [..., 3]`: `hat(w) x = w x x`."""
    x, y, z = jnp.moveaxis(w, -1, 0)
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def exp(twist: Array) -> RigidTransform:
    """Return the motions `[...]` of twists `[..., 6]`; the derivative is finite everywhere, at 0 too."""
    w, v = twist[..., :3], twist[..., 3:]
    a, b, c = (x[..., None, None] for x in _coefficients(jnp.sum(w**2, axis=-1)))
    W = hat(w)
    W2 = jnp.matmul(W, W, precision=HIGHEST)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=twist.dtype), W.shape)
    V = identity + b * W + c * W2
    return RigidTransform(R=identity + a * W + b * W2, t=jnp.einsum("...ij,...j->...i", V, v, precision=HIGHEST))


def exp_by_generators(twist: Array) -> RigidTransform:
    """Return `exp(twist)` with another derivative: along coordinate k it is `generator_k exp(twist)`, which is exact at 0 only.

    This is the derivative that the official code of PointNetLK writes by hand.
    """
    motion = jax.tree.map(jax.lax.stop_gradient, exp(twist))
    zero = twist - jax.lax.stop_gradient(twist)
    W, v = hat(zero[..., :3]), zero[..., 3:]
    R = motion.R + jnp.matmul(W, motion.R, precision=HIGHEST)
    return RigidTransform(R=R, t=motion.t + jnp.einsum("...ij,...j->...i", W, motion.t, precision=HIGHEST) + v)


def _coefficients(square: Array) -> tuple[Array, Array, Array]:
    """Return sin(u) / u, (1 - cos(u)) / u^2 and (u - sin(u)) / u^3 for `square` = u^2."""
    small = square < SERIES_BELOW**2
    q = jnp.where(small, square, 0)
    u = jnp.sqrt(jnp.where(small, 1, square))
    sine, half = jnp.sin(u), jnp.sin(u / 2)
    series = (
        1 - q / 6 * (1 - q / 20 * (1 - q / 42)),
        (1 - q / 12 * (1 - q / 30 * (1 - q / 56))) / 2,
        (1 - q / 20 * (1 - q / 42 * (1 - q / 72))) / 6,
    )
    closed = (sine / u, 2 * half**2 / u**2, (u - sine) / u**3)
    a, b, c = (jnp.where(small, x, y) for x, y in zip(series, closed, strict=True))
    return a, b, c
