"""PointNetLK (Aoki et al., CVPR 2019) and PointNetLK Revisited (Li et al., CVPR 2021): Lucas-Kanade on the features of whole clouds.

The Jacobian of the target's feature vector is computed once; then the source moves until its feature vector is the target's. The defaults
are those of the first paper, `revisited` gives those of the second.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.twists import exp, exp_by_generators
from cmig_jax.models.base import Model
from cmig_jax.models.pointnetlk.flags import PointNetLKFlags
from cmig_jax.nn.pointnet import PointNet
from cmig_jax.ops.pooling import maximum
from cmig_jax.structs import Batch, Prediction
from cmig_jax.transform import RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST
STOP = 1e-7  # iteration stops when no pair's twist is longer


@struct.dataclass
class Trace:
    """The iterations, along a first axis; those after the stop repeat the last one.

    Attributes:
        pose: `[n, B]` motions of the centred source.
        residual: `[n, B, C]` features of the moved source minus those of the target, before each twist.
        before: `[n, B, C]` the residual one iteration earlier, first zeros.
        twist: `[n, B, 6]`; the one of the stop was not applied.
        done: `[n]` whether this twist or one before was too short to be applied.
    """

    pose: RigidTransform
    residual: Array
    before: Array
    twist: Array
    done: Array


@struct.dataclass
class PointNetLKPrediction(Prediction):
    """The pose, and the iterations that led to it."""

    trace: Trace = struct.field(kw_only=True)


class PointNetLK(nn.Module):
    """Registers X (source) onto Y (target)."""

    flags: PointNetLKFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.encoder = PointNet(self.flags.widths, compute=self.compute)

    def __call__(
        self,
        batch: Batch,
        *,
        train: bool,
        key: Array | None = None,
        statistics_index: Array | None = None,
        point_index: Array | None = None,
    ) -> PointNetLKPrediction:
        """Predict the pose of each pair.

        Args:
            batch: the pairs.
            train: update the running statistics, and work with random points. (Statistics of the batch normalise nothing else.)
            key: random key of the points, needed in training with `training_points`.
            statistics_index: `[D]` points that update the running statistics, instead of random ones; the same for both clouds.
            point_index: `[D]` points for everything else.

        Raises:
            ValueError: no points to draw from, or no key to draw with.
        """
        mean_target, mean_source = (jnp.mean(x, axis=1, keepdims=True) for x in (batch.target, batch.source))
        target, source = batch.target - mean_target, batch.source - mean_source
        if train:
            if statistics_index is None or point_index is None:
                statistics_index, point_index = self._draw(min(target.shape[1], source.shape[1]), key)
            for cloud in (target, source):
                self.encoder(cloud[:, statistics_index], train=True)
            target, source = target[:, point_index], source[:, point_index]
        pooled, _, _, inverse = self.jacobian(target)
        trace = self.iterate(source, pooled, inverse, self.flags.iterations if train else self.flags.test_iterations)
        pose = trace.pose[-1]
        pose = RigidTransform(R=pose.R, t=(pose.apply(-mean_source) + mean_target)[:, 0])
        return PointNetLKPrediction(target_from_source=pose, trace=trace)

    def jacobian(self, target: Array) -> tuple[Array, Array, Array, Array]:
        """Differentiate the features of the centred target, moved by the inverse of a twist, at no twist.

        Returns:
            features `[B, C]`, the point `[B, C]` that each comes from, the Jacobian `[B, C, 6]` and its pseudo-inverse `[B, 6, C]`.
        """
        features = self.encoder(target, train=False)
        pooled, position = maximum(features, 1, self.compute.kernels), jnp.argmax(features, axis=1)
        encode, channelwise = self._encoder()
        if self.flags.jacobian == "analytic":
            point = jnp.take_along_axis(target, position[..., None], axis=1)
            slope = jax.grad(lambda x: jnp.sum(channelwise(x)))(point)
            J = -jnp.concatenate([jnp.cross(point, slope), slope], axis=-1)  # a point p moves by -(w x p + v)
        else:
            back = exp(-self.flags.step * jnp.eye(6, dtype=target.dtype))
            moved = jax.vmap(lambda motion: encode(RigidTransform(R=motion.R[None], t=motion.t[None]).apply(target)))(back)
            J = jnp.moveaxis(moved - pooled[None], 0, -1) / self.flags.step
        J = J if self.flags.learn_jacobian else jax.lax.stop_gradient(J)
        H = jnp.einsum("bci,bcj->bij", J, J, precision=HIGHEST)
        # As large as the rounding of H: a cloud that a twist does not change (a line, a point) has an inverse too.
        size, eps = jnp.trace(H, axis1=1, axis2=2)[:, None, None], jnp.finfo(H.dtype).eps
        ridge = eps * (size + eps) * jnp.eye(6, dtype=H.dtype)[None]
        return pooled, position, J, jnp.einsum("bij,bcj->bic", jnp.linalg.inv(H + ridge), J, precision=HIGHEST)

    def iterate(self, source: Array, pooled: Array, inverse: Array, iterations: int) -> Trace:
        """Move the centred source until its features are `pooled [B, C]`, given the pseudo-inverse `[B, 6, C]` of the Jacobian."""
        encode, B = self._encoder()[0], pooled.shape[0]

        def update(last: Trace) -> Trace:
            residual = encode(last.pose.apply(source)) - pooled
            twist = jnp.einsum("bic,bc->bi", inverse, residual, precision=HIGHEST)
            done = jnp.max(jnp.sum(jax.lax.stop_gradient(twist) ** 2, axis=-1)) < STOP**2
            # The official derivative of the exponential map.
            moved = exp_by_generators(twist).compose(last.pose)
            pose = jax.tree.map(lambda old, new: jnp.where(done, old, new), last.pose, moved)
            return Trace(pose=pose, residual=residual, before=last.residual, twist=twist, done=done)

        def step(last: Trace, _: None) -> tuple[Trace, Trace]:
            trace = jax.lax.cond(last.done, lambda trace: trace, update, last)
            return trace, trace

        none = jnp.zeros_like(pooled)
        twist = jnp.zeros((B, 6), pooled.dtype)
        start = Trace(RigidTransform.identity((B,), source.dtype), residual=none, before=none, twist=twist, done=jnp.asarray(False))
        return jax.lax.scan(step, start, length=iterations)[1]

    def _encoder(self) -> tuple[Callable[[Array], Array], ...]:
        """Return `PointNet.pooled` and `PointNet.channelwise` in evaluation mode as functions that JAX may transform."""
        encoder, variables = self.encoder.unbind()

        def pooled(points: Array) -> Any:
            return encoder.apply(variables, points, train=False, method="pooled")

        def channelwise(points: Array) -> Any:
            return encoder.apply(variables, points, method="channelwise")

        return jax.checkpoint(pooled) if self.compute.recompute else pooled, channelwise

    def _draw(self, points: int, key: Array | None) -> tuple[Any, Any]:
        """Return the indices of the points that update the running statistics, and of those for the rest."""
        count = self.flags.training_points
        if count > points:
            raise ValueError(f"model.training-points = {count}: expected at most the {points} points of the smaller cloud")
        if not count:
            return slice(None), slice(None)
        if key is None:
            raise ValueError("training draws points: expected a random key")
        first, second = (jax.random.permutation(k, points)[:count] for k in jax.random.split(key))
        return first, second


def losses(prediction: PointNetLKPrediction, batch: Batch, flags: PointNetLKFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return `pose`, the squared Frobenius norm of the pose error (mean over pairs), and `residual` on the features (sum over pairs)."""
    assert batch.target_from_source is not None
    error = prediction.target_from_source.compose(batch.target_from_source.inverse()).as_matrix()
    pose = jnp.mean(jnp.sum((error - jnp.eye(4, dtype=error.dtype)[None]) ** 2, axis=(1, 2)))
    trace = prediction.trace
    change = trace.residual[-1] - trace.before[-1] if flags.residual_loss == "change" else trace.residual[-1]
    return {"pose": pose, "residual": jnp.sum(change**2)}


POINTNETLK = Model(flags=PointNetLKFlags, build=PointNetLK, losses=losses)
