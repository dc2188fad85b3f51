"""What the networks that point from one cloud into another share (DCP, PRNet): features of both, the pose of pointers, errors of poses."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import Kernels
from cmig_jax.nn.recompute import call
from cmig_jax.ops.procrustes import weighted_procrustes
from cmig_jax.transform import RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST


def conditional(transformer: nn.Module, source: Array, target: Array, recompute: bool) -> tuple[Array, Array]:
    """Add to the features of each cloud, `[B, N, C]` and `[B, M, C]`, what the transformer makes of them and the other's."""
    of_source = call(transformer, source, target, recompute=recompute)
    return source + of_source, target + call(transformer, target, source, recompute=recompute)


def similarities(f: Array, g: Array) -> Array:
    """Return `f g^T / sqrt(C)`, `[B, N, M]`, of features `[B, N, C]` and `[B, M, C]`."""
    return jnp.einsum("bnc,bmc->bnm", f, g, precision=HIGHEST) / f.shape[-1] ** 0.5


def pointed_pose(pointer: Array, source: Array, target: Array, kernels: Kernels = "auto") -> tuple[RigidTransform, Array]:
    """Find the rigid transform from points to the means of the target that they point to; all points weigh the same.

    The target is centred first: pointers that are almost uniform lose digits otherwise, since they all give almost the same mean.

    Args:
        pointer: `[B, N, M]`; each row sums to 1.
        source: `[B, N, 3]`.
        target: `[B, M, 3]`.
        kernels: as in `weighted_procrustes`.

    Returns:
        target_from_source `[B]`, and the means `[B, N, 3]`.
    """
    centre = jnp.mean(target, axis=1, keepdims=True)
    partners = jnp.einsum("bnm,bmi->bni", pointer, target - centre, precision=HIGHEST)
    weight = jnp.full(source.shape[:2], 1 / source.shape[1], source.dtype)
    pose = weighted_procrustes(source, partners, weight, kernels=kernels)
    return RigidTransform(R=pose.R, t=pose.t + centre[:, 0]), partners + centre


def pose_errors(estimate: RigidTransform, truth: RigidTransform) -> tuple[Array, Array]:
    """Return the mean squares of `R^T R_true - I` and of `t - t_true` over pairs and elements; the first is that of `R - R_true`."""
    return jnp.mean((estimate.R - truth.R) ** 2), jnp.mean((estimate.t - truth.t) ** 2)


def round_trip_errors(there: RigidTransform, back: RigidTransform, translation: Array) -> tuple[Array, Array]:
    """Return the mean squares of `R_there R_back - I` and of `translation`, by which a loss says where the round trip ends."""
    return jnp.mean((there.R - back.inverse().R) ** 2), jnp.mean(translation**2)
