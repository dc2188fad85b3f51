"""The pose solver: weighted Procrustes (Eq. 11, "weighted SVD") with a closed-form derivative.

The derivative of a singular value decomposition is not finite where singular values repeat, but the rotation that it is used for
is smooth there. `project_to_rotation` therefore differentiates the projection itself: with M = V S U^T (S signed, so that
R = V U^T is a rotation), dR = V E U^T, E antisymmetric with E_ij = (A_ij - A_ji) / (s_i + s_j) and A = V^T dM U. It diverges
only where the rotation itself is undefined, as s_2 + s_3 -> 0.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.structs import RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST


def weighted_procrustes(
    source: Array, target: Array, weight: Array, centroid: Literal["weighted", "unweighted"] = "weighted"
) -> RigidTransform:
    """Find the rigid transform that takes corresponding points onto each other (Eq. 11).

    Args:
        source: `[..., K, 3]` points x.
        target: `[..., K, 3]` their correspondents x'.
        weight: `[..., K]` weights w >= 0, summing to 1 (or to 0, which gives the identity rotation).
        centroid: `weighted` minimises sum_i w_i |R x_i + t - x'_i|^2; `unweighted` takes plain means for the covariance, as the
            released network does.

    Returns:
        target_from_source `[...]`.
    """
    w = weight[..., None]
    mean_source, mean_target = jnp.sum(w * source, axis=-2), jnp.sum(w * target, axis=-2)
    if centroid == "weighted":
        centre_source, centre_target = mean_source, mean_target
    else:
        centre_source, centre_target = jnp.mean(source, axis=-2), jnp.mean(target, axis=-2)
    y = target - centre_target[..., None, :]
    x = source - centre_source[..., None, :]
    R = project_to_rotation(jnp.einsum("...ki,...kj->...ij", w * y, x, precision=HIGHEST))
    t = mean_target - jnp.einsum("...ij,...j->...i", R, mean_source, precision=HIGHEST)
    return RigidTransform(R=R, t=t)


@jax.custom_jvp
def project_to_rotation(matrix: Array) -> Array:
    """Return the rotation R that maximises trace(R^T matrix), for matrices `[..., 3, 3]`; a reflection is never returned."""
    V, _, Ut = _signed_svd(matrix)
    return jnp.matmul(V, Ut, precision=HIGHEST)


@project_to_rotation.defjvp
def _project_to_rotation_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (matrix,), (tangent,) = primals, tangents
    V, s, Ut = _signed_svd(matrix)
    A = jnp.einsum("...ji,...jk,...lk->...il", V, tangent, Ut, precision=HIGHEST)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=s.dtype), matrix.shape)
    denominator = s[..., :, None] + s[..., None, :] + identity  # the diagonal of A - A^T is 0 anyway
    E = (A - jnp.swapaxes(A, -1, -2)) / denominator
    return jnp.matmul(V, Ut, precision=HIGHEST), jnp.einsum("...ij,...jk,...kl->...il", V, E, Ut, precision=HIGHEST)


def _signed_svd(matrix: Array) -> tuple[Array, Array, Array]:
    """Decompose `matrix` = V diag(s) U^T with det(V U^T) = 1; the last s is negative for a reflection."""
    V, s, Ut = jnp.linalg.svd(matrix)
    sign = jnp.linalg.det(jnp.matmul(V, Ut, precision=HIGHEST))
    flip = jnp.stack([jnp.ones_like(sign), jnp.ones_like(sign), jnp.where(sign < 0, -1.0, 1.0).astype(sign.dtype)], axis=-1)
    return V * flip[..., None, :], s * flip, Ut
