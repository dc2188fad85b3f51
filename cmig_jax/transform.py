"""The pose type: a rotation and a translation, with NumPy or JAX arrays and any batch axes. Method names are jaxlie's."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

SMALLEST_STRETCH, LARGEST_STRETCH = 0.975, 1.025  # singular values of a rotation rounded to bfloat16 lie within


@struct.dataclass
class RigidTransform:
    """A rotation R `[..., 3, 3]` and a translation t `[..., 3]`: x becomes R x + t. Leading axes are batch axes.

    With NumPy arrays, methods return NumPy arrays.
    """

    R: Any
    t: Any

    @classmethod
    def identity(cls, batch_axes: tuple[int, ...] = (), dtype: Any = jnp.float32) -> RigidTransform:
        """Return the transform that moves nothing, as JAX arrays."""
        return cls(R=jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*batch_axes, 3, 3)), t=jnp.zeros((*batch_axes, 3), dtype))

    @classmethod
    def from_matrix(cls, matrix: Any) -> RigidTransform:
        """Split homogeneous matrices `[..., 4, 4]` (or `[..., 3, 4]`)."""
        return cls(R=matrix[..., :3, :3], t=matrix[..., :3, 3])

    def as_matrix(self) -> Any:
        """Return homogeneous matrices `[..., 4, 4]`."""
        numpy = np if isinstance(self.R, np.ndarray) else jnp
        top = numpy.concatenate([self.R, self.t[..., None]], axis=-1)
        bottom = numpy.broadcast_to(numpy.asarray([0, 0, 0, 1], top.dtype), (*self.get_batch_axes(), 1, 4))
        return numpy.concatenate([top, bottom], axis=-2)

    def get_batch_axes(self) -> tuple[int, ...]:
        """Return the shape of the batch axes."""
        return self.t.shape[:-1]

    def apply(self, points: Any) -> Any:
        """Move points `[..., N, 3]`."""
        return _product("...ij,...nj->...ni", self.R, points) + self.t[..., None, :]

    def compose(self, first: RigidTransform) -> RigidTransform:
        """Return the transform that applies `first`, then this one: `a_from_b.compose(b_from_c)` is `a_from_c`."""
        R = _product("...ij,...jk->...ik", self.R, first.R)
        return RigidTransform(R=R, t=self.apply(first.t[..., None, :])[..., 0, :])

    def inverse(self) -> RigidTransform:
        """Return the transform that undoes this one."""
        R = self.R.swapaxes(-1, -2)
        return RigidTransform(R=R, t=-_product("...ij,...j->...i", R, self.t))

    def angle(self) -> Any:
        """Return the angle of the rotation, radians in [0, pi], `[...]`.

        From the chord |R - I|_F = 2 sqrt(2) sin(angle / 2), which keeps its digits at small angles, unlike the arc cosine of the trace.
        """
        numpy = np if isinstance(self.R, np.ndarray) else jnp
        identity = numpy.broadcast_to(numpy.eye(3, dtype=self.R.dtype), self.R.shape)
        chord = numpy.sqrt(numpy.sum((self.R - identity) ** 2, axis=(-1, -2)))
        return 2 * numpy.arcsin(numpy.clip(chord / 8**0.5, 0, 1))

    def __getitem__(self, index: Any) -> RigidTransform:
        """Select from the batch axes (an index must not reach behind them)."""
        return RigidTransform(R=self.R[index], t=self.t[index])


def check_transform(R: ArrayLike, t: ArrayLike, name: object = "pose") -> RigidTransform:
    """Return poses as NumPy float64 with R orthonormal to rounding in float64.

    Args:
        R: `[..., 3, 3]`; the rounding of bfloat16 is accepted, and removed by projection to the nearest rotation.
        t: `[..., 3]`.
        name: what an error calls them.

    Raises:
        ValueError: other shapes, a value that is not finite, or an R that is not a rotation.
    """
    rotation, translation = np.asarray(R, np.float64), np.asarray(t, np.float64)
    if rotation.shape[-2:] != (3, 3) or translation.shape != (*rotation.shape[:-2], 3):
        raise ValueError(f"{name}: R of shape {rotation.shape}, t of shape {translation.shape}; expected [..., 3, 3] and [..., 3]")
    transform = valid_transform(rotation, translation)
    if transform is not None:
        return transform
    i = next(i for i in np.ndindex(rotation.shape[:-2]) if valid_transform(rotation[i], translation[i]) is None)
    value = f"R = {rotation[i].tolist()}, t = {translation[i].tolist()}"
    raise ValueError(f"{name}{list(i) or ''}: not a valid pose (not finite, or not a rotation): {value}")


def valid_transform(R: np.ndarray, t: np.ndarray) -> RigidTransform | None:
    """Return `[..., 3, 3]` and `[..., 3]` with R projected to the nearest rotation, or None where one is not a valid pose."""
    if not (np.isfinite(R).all() and np.isfinite(t).all()):
        return None
    V, stretch, Ut = np.linalg.svd(R)
    projected = V @ Ut
    rigid = (stretch > SMALLEST_STRETCH) & (stretch < LARGEST_STRETCH)
    return RigidTransform(R=projected, t=t) if rigid.all() and (np.linalg.det(projected) > 0).all() else None


def stack(transforms: list[RigidTransform]) -> RigidTransform:
    """Stack NumPy transforms along a new first axis."""
    return RigidTransform(R=np.stack([x.R for x in transforms]), t=np.stack([x.t for x in transforms]))


def _product(subscripts: str, a: Any, b: Any) -> Any:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.einsum(subscripts, a, b)
    return jnp.einsum(subscripts, a, b, precision=jax.lax.Precision.HIGHEST)
