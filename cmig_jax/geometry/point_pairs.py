"""Point-pair features: what is the same for two oriented points wherever they are moved to (Drost et al., CVPR 2010)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.geometry.distances import length

HIGHEST = jax.lax.Precision.HIGHEST


def point_pair_features(offset: Array, normal: Array, other_normal: Array) -> Array:
    """Return the angles (n_i, d), (n_j, d), (n_i, n_j) and the length |d| for d = x_j - x_i.

    Args:
        offset: `[..., 3]` d.
        normal: `[..., 3]` n_i.
        other_normal: `[..., 3]` n_j.

    Returns:
        `[..., 4]`, radians in [0, pi] and object units. A point with itself has length 0 and angles 0.
    """
    angles = (angle_between(normal, offset), angle_between(other_normal, offset), angle_between(normal, other_normal))
    return jnp.stack([*angles, length(offset)], axis=-1)


def angle_between(a: Array, b: Array) -> Array:
    """Return the angle between vectors `[..., 3]`, radians in `[0, pi]`; 0 with derivative 0 if one has no length."""
    cross, dot = length(jnp.cross(a, b)), jnp.einsum("...c,...c->...", a, b, precision=HIGHEST)
    undefined = (cross == 0) & (dot == 0)
    return jnp.where(undefined, 0, jnp.arctan2(cross, jnp.where(undefined, 1, dot)))
