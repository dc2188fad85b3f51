"""Rotations from and to unit quaternions `[..., 4]` (w, x, y, z)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

SHORTEST = 1e-12


def rotation_from_quaternion(quaternion: Array) -> Array:
    """Turn quaternions `[..., 4]` (w, x, y, z; any length but 0) into rotations `[..., 3, 3]`."""
    square = jnp.sum(quaternion**2, axis=-1)
    w, x, y, z = jnp.moveaxis(quaternion, -1, 0)
    s = 2.0 / square
    rows = [
        [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
        [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
        [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(R: Array) -> Array:
    """Turn rotations `[..., 3, 3]` into unit quaternions `[..., 4]` with w >= 0.

    The product q q^T is linear in R. Its row with the largest diagonal element is a multiple of q that loses no digits.
    """
    (a, b, c), (d, e, f), (g, h, i) = (jnp.moveaxis(row, -1, 0) for row in jnp.moveaxis(R, -2, 0))
    rows = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    product = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    best = jnp.argmax(jnp.diagonal(product, axis1=-2, axis2=-1), axis=-1)[..., None, None]
    quaternion = unit_quaternion(jnp.take_along_axis(product, best, axis=-2)[..., 0, :])
    return jnp.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def quaternion_product(a: Array, b: Array) -> Array:
    """Multiply quaternions `[..., 4]` (Hamilton): the rotation by `b`, then by `a`."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    parts = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return jnp.stack(parts, axis=-1)


def unit_quaternion(x: Array) -> Array:
    """Divide `x [..., 4]` by its length; 0 stays 0, and so does its derivative."""
    square = jnp.sum(x**2, axis=-1, keepdims=True)
    short = square < SHORTEST**2
    return jnp.where(short, x / SHORTEST, x / jnp.sqrt(jnp.where(short, 1, square)))
