"""What OMNet and FINet share: layers, iterations and losses of a pose that is regressed as a quaternion and a translation."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.rotations import quaternion_from_rotation, quaternion_product, rotation_from_quaternion
from cmig_jax.models.regression_flags import RegressionFlags
from cmig_jax.nn.mlp import Dense, NormedMLP
from cmig_jax.transform import RigidTransform

Pair = tuple[Array, Array]
"""Of the source and of the target."""


@struct.dataclass
class QuaternionPose:
    """A pose as a unit quaternion `[B, 4]` (w, x, y, z) and a translation `[B, 3]`."""

    quaternion: Array
    translation: Array

    @classmethod
    def identity(cls, pairs: int, dtype: jnp.dtype) -> QuaternionPose:
        """Return the pose that moves nothing."""
        return cls(jnp.broadcast_to(jnp.eye(1, 4, dtype=dtype), (pairs, 4)), jnp.zeros((pairs, 3), dtype))

    def transform(self) -> RigidTransform:
        """Return the pose as a rotation and a translation."""
        return RigidTransform(R=rotation_from_quaternion(self.quaternion), t=self.translation)

    def compose(self, first: QuaternionPose) -> QuaternionPose:
        """Return the pose that applies `first`, then this one."""
        translation = self.transform().apply(first.translation[:, None])[:, 0]
        return QuaternionPose(quaternion_product(self.quaternion, first.quaternion), translation)

    def follow(self, earlier: QuaternionPose, source: Array) -> tuple[QuaternionPose, Array]:
        """Compose with the pose so far, and move the source on; neither carries a gradient into this step."""
        earlier, source = jax.lax.stop_gradient((earlier, source))
        return self.compose(earlier), self.transform().apply(source)


class Regression(nn.Module):
    """Layers that regress numbers from a vector; their batch statistics are over the pairs of a batch."""

    widths: tuple[int, ...]
    outputs: int
    compute: ComputeConfig

    @nn.compact
    def __call__(self, pooled: Array, *, train: bool) -> Array:
        """Map `pooled [..., C]` to `[..., outputs]`."""
        hidden = NormedMLP(self.widths, self.compute, use_bias=True, name="hidden")(pooled, train=train)
        return Dense(self.outputs, compute=self.compute, name="last")(hidden)


def pose_losses(i: int, pose: QuaternionPose, truth: RigidTransform, flags: RegressionFlags) -> dict[str, Array]:
    """Return the mean absolute error of the quaternion and the mean squared error of the translation, weighted, of iteration `i`."""
    quaternion = quaternion_from_rotation(truth.R)
    if flags.quaternion_sign == "nearer":
        turned = jnp.sum(quaternion * pose.quaternion, axis=-1, keepdims=True) < 0
        quaternion = jnp.where(turned, -quaternion, quaternion)
    return {
        f"quaternion_{i}": jnp.mean(jnp.abs(quaternion - pose.quaternion)),
        f"translation_{i}": flags.translation_weight * jnp.mean((truth.t - pose.translation) ** 2),
    }
