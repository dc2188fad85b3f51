"""FINet (Xu et al., AAAI 2022): branches for rotation and translation.

Read top-down: n times encode in two branches, exchange features between the clouds, fuse, regress rotation and translation.
Written from a summary of the network, without recorded cases and weights of the authors: numbers could not be compared with theirs. The
number of parameters is the official one (142,199,324). Not checked, and decided here:
the translation reads its own fused vector and those of the rotation, own and other cloud's; distances of features are means over channels;
in training the network goes on with the pooled features of all points; for the sensitivity only the source is moved, its motion has no
gradient, and the extra passes count in the running statistics. The official codes weigh it with 0.001 (MegEngine) and 0.0005 (PyTorch).
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.rotations import unit_quaternion
from cmig_jax.models.base import Model
from cmig_jax.models.finet.flags import FINetFlags
from cmig_jax.models.regressed_pose import Pair, QuaternionPose, Regression, pose_losses
from cmig_jax.nn.mlp import Dense, NormedMLP
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.nn.recompute import call
from cmig_jax.ops.moments import moments
from cmig_jax.ops.pooling import maximum
from cmig_jax.structs import Batch, Prediction

ROTATION, TRANSLATION = 0, 1
SOURCE = 0


@struct.dataclass
class Probes:
    """Pooled features of one iteration under changes of its input; the second axis is the branch: rotation, translation.

    Attributes:
        whole: `[B, 2, 2, D]` of all points; the third axis is the cloud.
        thinned: the same with points left out, or None.
        rotated: `[B, 2, D]` of the source after only the rotation of this iteration, or None.
        translated: after only its translation, or None.
    """

    whole: Array
    thinned: Array | None = None
    rotated: Array | None = None
    translated: Array | None = None


@struct.dataclass
class Step:
    """The pose after an iteration, from the given source to the target, and in training its features."""

    pose: QuaternionPose
    probes: Probes | None


@struct.dataclass(kw_only=True)
class FINetPrediction(Prediction):
    """What the network returns, with its iterations."""

    steps: tuple[Step, ...]


class FINet(nn.Module):
    """Registers the source onto the target."""

    flags: FINetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.stages = tuple(Stage(self.flags, self.compute) for _ in range(self.flags.iterations))

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> FINetPrediction:
        """Predict the pose of each pair; in training, `key` draws the points to leave out.

        Raises:
            ValueError: training with that loss, without a key.
        """
        flags, source = self.flags, batch.source
        if train and key is None and flags.dropout_weight and flags.regularised:
            raise ValueError("training draws points to leave out: expected a key, got None")
        pose, steps = QuaternionPose.identity(source.shape[0], source.dtype), []
        for i, stage in enumerate(self.stages):
            seen = jax.lax.stop_gradient(source)
            own = None if key is None else jax.random.fold_in(key, i)
            probed = train and i < flags.regularised
            step, probes = call(stage, seen, batch.target, own, recompute=self.compute.recompute, train=train, probed=probed)
            pose, source = step.follow(pose, seen)
            steps.append(Step(pose, probes))
        return FINetPrediction(target_from_source=pose.transform(), steps=tuple(steps))


class Stage(nn.Module):
    """One iteration; both clouds go through a layer together, with joint batch statistics."""

    flags: FINetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        flags, compute = self.flags, self.compute
        self.encoders = tuple(Encoder(flags, compute) for _ in (ROTATION, TRANSLATION))
        self.fusions = tuple(NormedMLP(flags.fusion_widths, compute, use_bias=True) for _ in (ROTATION, TRANSLATION))
        self.rotation, self.centre = Regression(flags.regression_widths, 4, compute), Regression(flags.regression_widths, 3, compute)

    def __call__(
        self, source: Array, target: Array, key: Array | None, *, train: bool, probed: bool
    ) -> tuple[QuaternionPose, Probes | None]:
        """Return the pose from `source` as given to `target`, and with `probed` the features that the losses compare."""
        points = [encoder((source, target), train=train) for encoder in self.encoders]
        whole = self._pooled(points)
        pose = self._regress(whole, source.dtype, train)
        if not probed:
            return pose, None
        thinned, moved = None, {}
        if self.flags.dropout_weight and key is not None:
            keys = jax.random.split(key)
            kept = [jax.random.bernoulli(k, 1 - self.flags.dropout, x.shape[:2]) for k, x in zip(keys, (source, target), strict=True)]
            thinned = self._pooled([(x * kept[0][..., None], y * kept[1][..., None]) for x, y in points])
        if self.flags.sensitivity_weight:
            turn = jax.lax.stop_gradient(pose.transform())
            for name, x in {"rotated": turn.apply(source) - turn.t[:, None], "translated": source + turn.t[:, None]}.items():
                moved[name] = self._pooled([encoder((x, target), train=train) for encoder in self.encoders])[:, :, SOURCE]
        return pose, Probes(whole, thinned, **moved)

    def _pooled(self, points: list[Pair]) -> Array:
        """Stack the maxima over the points of both branches and clouds, `[B, 2, 2, D]`."""
        pooled = [jnp.stack([maximum(x, 1, self.compute.kernels) for x in pair], axis=1) for pair in points]
        return jnp.stack(pooled, axis=1)

    def _regress(self, pooled: Array, dtype: jnp.dtype, train: bool) -> QuaternionPose:
        """Fuse the pooled features `[B, 2, 2, D]`; the translation is the difference of two centres, one regressed for each cloud."""
        with_other = jnp.concatenate([pooled, pooled[:, :, ::-1]], axis=-1)
        turn, shift = (fusion(with_other[:, branch], train=train) for branch, fusion in enumerate(self.fusions))  # each [B, 2, F]
        all_four = jnp.concatenate([shift, turn], axis=-1)
        quaternion = self.rotation(all_four.reshape(len(all_four), -1), train=train)
        centre = self.centre(jnp.concatenate([shift, turn, turn[:, ::-1]], axis=-1), train=train).astype(dtype)
        return QuaternionPose(unit_quaternion(quaternion.astype(dtype)), centre[:, 1] - centre[:, 0])


class Encoder(nn.Module):
    """One branch: layers on every point, some beside the maximum of the other cloud."""

    flags: FINetFlags
    compute: ComputeConfig

    @nn.compact
    def __call__(self, clouds: Pair, *, train: bool) -> Pair:
        """Map both clouds, each `[B, N_c, 3]`, to the outputs of all layers, `[B, N_c, D]`."""
        latest, collected = list(clouds), ([], [])
        for i, width in enumerate(self.flags.encoder_widths):
            # A layer on [point, other's maximum], as two products: that with the maximum once for each cloud.
            layer = Dense(width, use_bias=False, compute=self.compute, name=f"layer_{i}")
            outputs = [layer(x) for x in latest]
            if i in self.flags.exchange_after:
                exchange = Dense(width, use_bias=False, compute=self.compute, name=f"exchange_{i}")
                vectors = [jax.lax.stop_gradient(maximum(x, 1, self.compute.kernels)) for x in reversed(latest)]
                outputs = [x + exchange(vector)[:, None] for x, vector in zip(outputs, vectors, strict=True)]
            batch = moments(outputs, self.compute.kernels) if train else None
            affine = BatchNorm(width, self.compute, name=f"norm_{i}").affine(batch)
            latest = [nn.relu(affine(x)) for x in outputs]
            for own, x in zip(collected, latest, strict=True):
                own.append(x)
        source, target = (jnp.concatenate(own, axis=-1).astype(clouds[0].dtype) for own in collected)
        return source, target


def losses(prediction: FINetPrediction, batch: Batch, flags: FINetFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return `quaternion_<i>` and `translation_<i>` of every iteration, and `sensitivity_<i>` and `dropout_<i>` of the first ones."""
    assert batch.target_from_source is not None
    terms = {}
    for i, step in enumerate(prediction.steps):
        terms |= pose_losses(i, step.pose, batch.target_from_source, flags)
        if step.probes is None:
            continue
        if step.probes.rotated is not None:
            terms[f"sensitivity_{i}"] = flags.sensitivity_weight * sensitivity(step.probes, flags.sensitivity_margin)
        if step.probes.thinned is not None:
            terms[f"dropout_{i}"] = flags.dropout_weight * jnp.mean((step.probes.thinned - step.probes.whole) ** 2)
    return terms


def sensitivity(probes: Probes, margin: float) -> Array:
    """Return by how much a branch's features change too little under its own motion, and how much under the other branch's motion."""
    assert probes.rotated is not None
    assert probes.translated is not None
    changes = [jnp.mean((x - probes.whole[:, :, SOURCE]) ** 2, axis=-1) for x in (probes.rotated, probes.translated)]  # each [B, 2]
    by_rotation, by_translation = changes
    lacking = nn.relu(margin - by_rotation[:, ROTATION]) + nn.relu(margin - by_translation[:, TRANSLATION])
    return jnp.mean(lacking + by_rotation[:, TRANSLATION] + by_translation[:, ROTATION])


FINET = Model(flags=FINetFlags, build=FINet, losses=losses)
