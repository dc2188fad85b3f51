"""PCRNet, iterative (Sarode et al., 2019): a pose regressed from the features of two whole clouds, n times with the same weights.

The official code's optional dropout is left out; it is off by default. Its pose is that of the centred clouds; this one is of the clouds
as given, so the loss is the same.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import chamfer_distance
from cmig_jax.geometry.rotations import rotation_from_quaternion
from cmig_jax.models.base import Model
from cmig_jax.models.pcrnet.flags import PCRNetFlags
from cmig_jax.nn.mlp import MLP
from cmig_jax.nn.pointnet import PointNet
from cmig_jax.structs import Batch, Prediction
from cmig_jax.transform import RigidTransform

SHORTEST = 1e-12  # a shorter quaternion turns nothing


@struct.dataclass
class Step:
    """One iteration, or several along a first axis.

    Attributes:
        feature: `[B, C]` of the source before it is moved.
        regressed: `[B, 7]` quaternion (w, x, y, z) before it is normalised, and translation.
        pose: `[B]` of all iterations so far, from the centred source to the centred target.
        source: `[B, N, 3]` the moved source.
    """

    feature: Array
    regressed: Array
    pose: RigidTransform
    source: Array


class PCRNet(nn.Module):
    """Registers X (source) onto Y (target)."""

    flags: PCRNetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.encoder = PointNet(self.flags.widths, norm="none", compute=self.compute)
        self.head = MLP((*self.flags.head_widths, 7), self.compute)

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> Prediction:
        """Predict the pose of each pair; training and evaluation are the same, and draw nothing."""
        mean_target, mean_source = (jnp.mean(x, axis=1, keepdims=True) for x in (batch.target, batch.source))
        _, steps = self.register(batch.source - mean_source, batch.target - mean_target)
        pose: RigidTransform = steps.pose[-1]
        return Prediction(RigidTransform(R=pose.R, t=(pose.apply(-mean_source) + mean_target)[:, 0]))

    def register(self, source: Array, target: Array) -> tuple[Array, Step]:
        """Register centred clouds; return the target's features `[B, C]` and the iterations, along a first axis."""
        feature = self.encoder.pooled(target, train=False)

        def step(network: PCRNet, last: tuple[RigidTransform, Array], _: None) -> tuple[tuple[RigidTransform, Array], Step]:
            found = network.step(*last, feature)
            return (found.pose, found.source), found

        step = nn.remat(step) if self.compute.recompute else step
        scan = nn.scan(step, variable_broadcast="params", split_rngs={"params": False}, length=self.flags.iterations)
        return feature, scan(self, (RigidTransform.identity(source.shape[:1], source.dtype), source), None)[1]

    def step(self, pose: RigidTransform, source: Array, target_feature: Array) -> Step:
        """Regress a pose from the features of both clouds, and move the source by it."""
        feature = self.encoder.pooled(source, train=False)
        regressed = self.head(jnp.concatenate([target_feature, feature], axis=-1)).astype(source.dtype)
        identity = jnp.eye(1, 4, dtype=source.dtype)
        quaternion = regressed[:, :4] + identity if self.flags.from_identity else regressed[:, :4]
        zero = jnp.sum(quaternion**2, axis=-1, keepdims=True) < SHORTEST**2
        motion = RigidTransform(R=rotation_from_quaternion(jnp.where(zero, identity, quaternion)), t=regressed[:, 4:])
        return Step(feature=feature, regressed=regressed, pose=motion.compose(pose), source=motion.apply(source))


def losses(prediction: Prediction, batch: Batch, flags: PCRNetFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return `chamfer`, the mean distance between the moved source and the target (released code; the paper: earth mover's distance)."""
    return {"chamfer": jnp.mean(chamfer_distance(batch.target, prediction.target_from_source.apply(batch.source)))}


PCRNET = Model(flags=PCRNetFlags, build=PCRNet, losses=losses)
