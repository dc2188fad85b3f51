"""DCP: Deep Closest Point (Wang and Solomon, ICCV 2019), versions 1 and 2.

Features of each cloud, made conditional on the other cloud by a transformer (v2), point softly into the target; the pose follows from
a singular value decomposition.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import Model
from cmig_jax.models.dcp.flags import DCPFlags
from cmig_jax.nn.attention import PairTransformer
from cmig_jax.nn.edgeconv import StaticEdgeEncoder
from cmig_jax.nn.pointer import conditional, pointed_pose, pose_errors, round_trip_errors, similarities
from cmig_jax.structs import Batch, Correspondences, Prediction
from cmig_jax.transform import RigidTransform

CYCLE_WEIGHT = 0.1


@struct.dataclass(kw_only=True)
class DCPPrediction(Prediction):
    """What the network returns.

    Attributes:
        source_from_target: `[B]` the estimated poses of the way back, the inverse ones without a loss of the cycle.
        partners: `[B, N, 3]` the mean of the target that each source point points to.
    """

    source_from_target: RigidTransform
    partners: Array


class DCPNetwork(nn.Module):
    """The network, read top-down."""

    flags: DCPFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        flags = self.flags
        self.encoder = StaticEdgeEncoder(flags.k, flags.widths, flags.dim, self.compute)
        if flags.pointer == "transformer":
            self.transformer = PairTransformer(flags.dim, flags.heads, flags.feed_forward, self.compute)

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> DCPPrediction:
        """Predict poses from `batch`; `key` is not read, since nothing is random.

        Raises:
            ValueError: too few points.
        """
        (B, N, _), M = batch.source.shape, batch.target.shape[1]
        if min(N, M) < self.flags.needs.points:
            raise ValueError(f"expected at least {self.flags.needs.points} points (neighbours) in each cloud, got {N} and {M}")
        source, target = self.encoder(batch.source, train=train), self.encoder(batch.target, train=train)
        f, g = self.embed(source, target)
        pointer = self.point(f, g)
        pose, partners = pointed_pose(pointer, batch.source, batch.target, self.compute.kernels)
        back = pose.inverse()
        if self.flags.cycle != "off":
            back, _ = pointed_pose(self.point(g, f), batch.target, batch.source, self.compute.kernels)
        return DCPPrediction(
            target_from_source=pose,
            correspondences=Correspondences(
                source_index=jnp.broadcast_to(jnp.arange(N), (B, N)),
                target_index=jnp.broadcast_to(jnp.arange(M), (B, M)),
                partner=jnp.argmax(pointer, axis=-1),
                weight=jnp.full((B, N), 1 / N, batch.source.dtype),
            ),
            source_from_target=back,
            partners=partners,
        )

    def embed(self, source: Array, target: Array) -> tuple[Array, Array]:
        """Make the features of each cloud `[B, N, C]`, `[B, M, C]` conditional on the other's (Sec. 4.2)."""
        if self.flags.pointer == "identity":
            return 2 * source, 2 * target
        return conditional(self.transformer, source, target, self.compute.recompute)

    def point(self, f: Array, g: Array) -> Array:
        """Return for each point of one cloud a distribution over the other's (Sec. 4.3), `[B, N, M]`."""
        return nn.softmax(similarities(f, g), axis=-1)


def losses(prediction: DCPPrediction, batch: Batch, flags: DCPFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return the errors of the pose (Sec. 4.5; means over the elements, where the paper sums), and those of the cycle with their weight."""
    assert batch.target_from_source is not None
    pose, back = prediction.target_from_source, prediction.source_from_target
    rotation, translation = pose_errors(pose, batch.target_from_source)
    terms = {"rotation": rotation, "translation": translation}
    if flags.cycle != "off":
        turned = (back.inverse() if flags.cycle == "official" else back).R
        end = RigidTransform(turned, back.t).apply(pose.t[:, None])[:, 0]
        rotation, translation = round_trip_errors(pose, back, end)
        terms |= {"cycle_rotation": CYCLE_WEIGHT * rotation, "cycle_translation": CYCLE_WEIGHT * translation}
    return terms


DCP = Model(flags=DCPFlags, build=DCPNetwork, losses=losses)
