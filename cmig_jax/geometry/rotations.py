"""Rotations from other representations."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


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
