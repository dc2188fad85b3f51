"""The pose solver: weighted Procrustes (Eq. 11, "weighted SVD"), and the rotation nearest to a matrix at its core.

The derivative of a singular value decomposition is not finite where singular values repeat, but the rotation is smooth there. The fast
version differentiates the projection itself: with M = V S U^T (S signed, so that R = V U^T is a rotation), dR = V E U^T with E
antisymmetric, E_ij = (A_ij - A_ji) / (s_i + s_j) and A = V^T dM U. It diverges only where the rotation itself is undefined, as
s_2 + s_3 -> 0. The plain version differentiates the decomposition, and is for checks.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import Kernels
from cmig_jax.transform import RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST


def weighted_procrustes(
    source: Array,
    target: Array,
    weight: Array,
    centroid: Literal["weighted", "unweighted"] = "weighted",
    kernels: Kernels = "auto",
) -> RigidTransform:
    """Find the rigid transform between corresponding points (Eq. 11).

    Args:
        source: `[..., K, 3]` points x.
        target: `[..., K, 3]` their correspondents x'.
        weight: `[..., K]` weights w >= 0 that sum to 1 (or to 0, which gives the identity rotation).
        centroid: `weighted` minimises sum_i w_i |R x_i + t - x'_i|^2; `unweighted` takes plain means in the covariance, as the
            released network does.
        kernels: version of the projection to a rotation.

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
    R = project_to_rotation(jnp.einsum("...ki,...kj->...ij", w * y, x, precision=HIGHEST), kernels)
    t = mean_target - jnp.einsum("...ij,...j->...i", R, mean_source, precision=HIGHEST)
    return RigidTransform(R=R, t=t)


def project_to_rotation(matrix: Array, kernels: Kernels = "auto") -> Array:
    """Return the rotation R that maximises trace(R^T matrix), for `[..., 3, 3]`; never a reflection.

    `auto` takes the fast version on every backend: it alone has a finite derivative for repeated singular values.
    """
    return _plain(matrix) if kernels == "plain" else _fast(matrix)


def _plain(matrix: Array) -> Array:
    V, _, Ut = _signed_svd(matrix)
    return jnp.matmul(V, Ut, precision=HIGHEST)


_fast = jax.custom_jvp(_plain)


@_fast.defjvp
def _fast_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
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
