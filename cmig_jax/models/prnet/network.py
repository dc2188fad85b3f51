"""PRNet: Partial Registration Network (Wang and Solomon, NeurIPS 2019).

DCP's features, on graphs that are built anew for each layer; the keypoints of each cloud have the largest features; a predicted
temperature makes their matching sharp or soft; the source moves, and everything is repeated with the same weights.
"""

from __future__ import annotations

from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import Model
from cmig_jax.models.prnet.flags import PRNetFlags
from cmig_jax.nn.attention import PairTransformer
from cmig_jax.nn.edgeconv import PointEncoder
from cmig_jax.nn.mlp import Dense, NormedMLP
from cmig_jax.nn.pointer import conditional, pointed_pose, pose_errors, round_trip_errors, similarities
from cmig_jax.ops.neighbours import top_k
from cmig_jax.structs import Batch, Correspondences, Prediction
from cmig_jax.transform import RigidTransform

NEGATIVE_SLOPE = 0.2
COLDEST, HOTTEST = 0.01, 100.0
TEMPERATURE_WIDTHS = (128, 128, 128)


@struct.dataclass
class Keypoints:
    """Chosen points of a cloud: indices `[B, K]`, coordinates `[B, K, 3]`, features `[B, K, C]`."""

    index: Array
    points: Array
    features: Array


@struct.dataclass
class Iteration:
    """What one iteration finds.

    Attributes:
        step: pose from the moved source to the target.
        back: pose from the target to the moved source, the inverse one without a loss of the cycle.
        pose: of the source as given, after this step.
        disparity: `[B, C]` absolute difference of the mean features of the two clouds' keypoints.
    """

    step: RigidTransform
    back: RigidTransform
    pose: RigidTransform
    disparity: Array


@struct.dataclass(kw_only=True)
class PRNetPrediction(Prediction):
    """What the network returns: the result, and all iterations."""

    iterations: tuple[Iteration, ...]


class PRNet(nn.Module):
    """The network, read top-down."""

    flags: PRNetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        flags, compute, slope = self.flags, self.compute, NEGATIVE_SLOPE
        self.encoder = PointEncoder(flags.k, flags.widths, flags.dim, compute, linked=False, relative=False, negative_slope=slope)
        self.transformer = PairTransformer(flags.dim, flags.heads, flags.feed_forward, compute, slope)
        self.temperature_hidden = NormedMLP(TEMPERATURE_WIDTHS, compute, use_bias=True)
        self.temperature_last = Dense(1, compute=compute)

    def __call__(
        self, batch: Batch, *, train: bool, key: Array | None = None, noise: Sequence | Array | None = None, order: Array | None = None
    ) -> PRNetPrediction:
        """Predict poses from `batch`.

        Args:
            batch: clouds.
            train: with batch statistics.
            key: of the Gumbel noise; fixed if absent in evaluation.
            noise: the Gumbel noise to use instead, for each iteration that of the matching `[B, K, L]` and of the one back `[B, L, K]`.
            order: `[n, 2, B, K]` keypoints to use instead of choosing them, for each iteration those of the source and of the target.

        Raises:
            ValueError: too few points, or training without a key.
        """
        self._check(batch, train, key, noise)
        source, pose, iterations = batch.source, RigidTransform.identity(batch.source.shape[:1], batch.source.dtype), []
        found = None
        for i in range(self.flags.iterations):
            chosen = (None, None) if order is None else order[i]
            f, g = self.embed(self.encode(source, train), self.encode(batch.target, train))
            x, y = self.choose(source, f, train, chosen[0]), self.choose(batch.target, g, train, chosen[1])
            disparity = jnp.abs(jnp.mean(x.features, axis=1) - jnp.mean(y.features, axis=1))
            temperature, logits = self.temperature(disparity, train), self.match(x, y)
            there, again = self._noise(key, i, logits) if noise is None else noise[i]
            pointer = self.point(logits, temperature, there)
            step, _ = self.solve(pointer, x.points, y.points)
            back = step.inverse()
            if self.flags.cycle != "off":
                back, _ = self.solve(self.point(logits.swapaxes(1, 2), temperature, again), y.points, x.points)
            source, pose = step.apply(source), step.compose(pose)
            iterations.append(Iteration(step, back, pose, disparity))
            weight = jnp.full(x.index.shape, 1 / x.index.shape[1], source.dtype)
            found = Correspondences(x.index, y.index, jnp.argmax(pointer, axis=-1), weight)
        return PRNetPrediction(target_from_source=pose, correspondences=found, iterations=tuple(iterations))

    def encode(self, cloud: Array, train: bool) -> Array:
        """Encode a cloud `[B, N, 3]` to `[B, N, C]`, by itself: each has its own batch statistics."""
        (features,) = self.encoder((cloud,), train=train)
        return features

    def embed(self, source: Array, target: Array) -> tuple[Array, Array]:
        """Make the features of each cloud conditional on the other's."""
        return conditional(self.transformer, source, target, self.compute.recompute)

    def choose(self, points: Array, features: Array, train: bool, index: Array | None) -> Keypoints:
        """Choose the keypoints of a cloud, by their scores or by `index [B, K]`."""
        count, score = self.flags.keypoints if train else self.flags.test_keypoints or self.flags.keypoints, self.score(features)
        if index is None:
            index = top_k(score, min(count, points.shape[1]))
        take = jax.vmap(lambda x, i: x[i])
        return Keypoints(index, take(points, index), take(features, index))

    def score(self, features: Array) -> Array:
        """Return the lengths of the features, `[B, N]`; they have no derivative."""
        return jnp.sqrt(jnp.sum(jax.lax.stop_gradient(features) ** 2, axis=-1))

    def temperature(self, disparity: Array, train: bool) -> Array:
        """Predict the temperature of the matching from how the clouds differ, `[B, 1]`; no derivative at its bounds."""
        raw = self.temperature_last(self.temperature_hidden(disparity, train=train))
        return jnp.clip(nn.relu(raw), COLDEST, HOTTEST).astype(disparity.dtype)

    def match(self, source: Keypoints, target: Keypoints) -> Array:
        """Return the similarities of the keypoints, `[B, K, L]`."""
        return similarities(source.features, target.features)

    def point(self, logits: Array, temperature: Array, noise: Array | None) -> Array:
        """Return for each keypoint of one cloud its partner among the other's, as weights `[B, K, L]`."""
        scale = temperature[:, :, None]
        if self.flags.matching == "softmax":
            return nn.softmax(scale * logits, axis=-1)
        assert noise is not None
        soft = nn.softmax((logits + noise) / scale, axis=-1)
        hard = jax.nn.one_hot(jnp.argmax(soft, axis=-1), soft.shape[-1], dtype=soft.dtype)
        return soft + jax.lax.stop_gradient(hard - soft)

    def solve(self, pointer: Array, source: Array, target: Array) -> tuple[RigidTransform, Array]:
        """Return the pose that takes the keypoints to their partners, and the partners."""
        return pointed_pose(pointer, source, target, self.compute.kernels)

    def _noise(self, key: Array | None, i: int, logits: Array) -> tuple[Array | None, Array | None]:
        if self.flags.matching == "softmax":
            return None, None
        B, K, L = logits.shape
        B = 1 if key is None else B
        keys = jax.random.split(jax.random.fold_in(jax.random.key(0) if key is None else key, i))
        return jax.random.gumbel(keys[0], (B, K, L), logits.dtype), jax.random.gumbel(keys[1], (B, L, K), logits.dtype)

    def _check(self, batch: Batch, train: bool, key: Array | None, noise: Sequence | Array | None) -> None:
        N, M, needs = batch.source.shape[1], batch.target.shape[1], self.flags.needs
        fewest = needs.training_points if train else needs.points
        if min(N, M) < fewest:
            raise ValueError(f"expected at least {fewest} points (neighbours, keypoints) in each cloud, got {N} and {M}")
        if train and key is None and noise is None and self.flags.matching == "gumbel":
            raise ValueError("training draws Gumbel noise: expected a key or the noise")


def losses(prediction: PRNetPrediction, batch: Batch, flags: PRNetFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return for each iteration the error of the pose so far, the disparity of the features and the error of the cycle."""
    assert batch.target_from_source is not None
    terms = {}
    for i, found in enumerate(prediction.iterations):
        weight, step, back = flags.discount**i, found.step, found.back
        terms[f"pose_{i}"] = weight * sum(pose_errors(found.pose, batch.target_from_source))
        terms[f"feature_{i}"] = weight * flags.feature_weight * jnp.mean(found.disparity)
        if flags.cycle != "off":
            end = step.t + back.t if flags.cycle == "official" else step.compose(back).t
            terms[f"cycle_{i}"] = weight * flags.cycle_weight * sum(round_trip_errors(step, back, end))
    return terms


PRNET = Model(flags=PRNetFlags, build=PRNet, losses=losses)
