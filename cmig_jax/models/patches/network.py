"""The patch transformer: soft correspondences between the patches of two clouds, a weighted Procrustes, and again from there.

The network that comes with the package. It is ours; its parts are not: patches by shared layers and a maximum are PointNet++'s (Qi et al.,
NeurIPS 2017), a transformer between two clouds and soft correspondences are DCP's (Wang and Solomon, ICCV 2019), overlap scores beside
them are those of Predator and REGTR (Huang et al., CVPR 2021; Yew and Lee, CVPR 2022).
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import squared_distances
from cmig_jax.models.base import Model
from cmig_jax.models.cmignet.keypoints import random_points
from cmig_jax.models.patches.flags import PatchFlags
from cmig_jax.models.patches.images import PixelFeatures, ViewTokens
from cmig_jax.models.patches.losses import losses
from cmig_jax.models.patches.prediction import Matches, PatchPrediction
from cmig_jax.nn.attention import Attention, CrossAttention, FeedForward
from cmig_jax.nn.mlp import MLP, Dense
from cmig_jax.nn.norm import LayerNorm
from cmig_jax.nn.pointer import similarities
from cmig_jax.ops.edges import gather
from cmig_jax.ops.neighbours import nearest, top_k
from cmig_jax.ops.pooling import maximum
from cmig_jax.ops.procrustes import weighted_procrustes
from cmig_jax.structs import Batch, Correspondences
from cmig_jax.transform import RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST
OFFSET_SCALE = 8.0  # offsets within a patch are about an eighth of an object; multiplied so, they are as large as its coordinates


class PatchTransformer(nn.Module):
    """Registers the source onto the target."""

    flags: PatchFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        flags, compute = self.flags, self.compute
        self.encoder = PatchEncoder(flags.k, flags.patch_widths, flags.dim, compute)
        self.layers = [PairLayer(flags.dim, flags.heads, flags.feed_forward, compute) for _ in range(flags.layers)]
        self.last_norm = LayerNorm()
        self.projection = Dense(flags.dim, compute=compute)
        self.sharpness = self.param("sharpness", nn.initializers.zeros, ())
        self.overlap = MLP((flags.dim // 2, 1), compute)
        if flags.image != "none":
            self.images = (PixelFeatures if flags.image == "pixels" else ViewTokens)(flags.dim, compute)
        if flags.image == "views":
            self.attention_to_views = CrossAttention(flags.dim, compute)

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> PatchPrediction:
        """Predict poses from `batch`; `key` draws the patches in training, which are the same in every evaluation.

        Raises:
            ValueError: too few points, or not the views that the flags ask for.
        """
        (B, N, _), M = batch.source.shape, batch.target.shape[1]
        if min(N, M) < self.flags.needs.points:
            raise ValueError(f"expected at least {self.flags.needs.points} points (a patch) in each cloud, got {N} and {M}")
        count = self.flags.patches if train else self.flags.test_patches
        keys = jax.random.split(jax.random.key(0) if key is None else key)
        source_index, target_index = (random_points(k, B, n, min(count, n)) for k, n in zip(keys, (N, M), strict=True))
        images = self.look(batch, source_index, target_index)
        pose = RigidTransform.identity((B,), batch.source.dtype)
        for _ in range(1 if train else self.flags.passes):
            matches = self.match(pose.apply(batch.source), batch.target, source_index, target_index, images)
            pose = matches.step.compose(pose)
        return PatchPrediction(
            target_from_source=pose,
            correspondences=Correspondences(source_index, target_index, jnp.argmax(matches.match, axis=-1), matches.weight),
            source_overlap=_of_nearest(pose.apply(batch.source), matches.step.apply(matches.source), nn.sigmoid(matches.source_logit)),
            target_overlap=_of_nearest(batch.target, matches.target, nn.sigmoid(matches.target_logit)),
            matches=matches,
        )

    def look(self, batch: Batch, source_index: Array, target_index: Array) -> tuple[Array, Array] | None:
        """Encode the views of both clouds: a feature for each patch, or for each view; None without images."""
        if self.flags.image == "none":
            return None
        if batch.views is None or batch.views.shape[1] != 2:
            found = None if batch.views is None else batch.views.shape
            raise ValueError(f"model.image = {self.flags.image} reads views of both clouds, [B, 2, V, H, W, 1]: got {found}")
        clouds = (batch.source, source_index), (batch.target, target_index)
        source, target = (self.images(batch.views[:, i], *cloud) for i, cloud in enumerate(clouds))
        return source, target

    def match(
        self, source: Array, target: Array, source_index: Array, target_index: Array, images: tuple[Array, Array] | None = None
    ) -> Matches:
        """Match the patches around chosen points of both clouds, and solve for the pose.

        The clouds are moved to their centroids first: what is left of a translation comes from the crops alone.
        """
        (x, f), (y, g) = (
            (gather(cloud, index), self.encoder(cloud - jnp.mean(cloud, axis=1, keepdims=True), index))
            for cloud, index in ((source, source_index), (target, target_index))
        )
        if images is not None and self.flags.image == "pixels":
            f, g = f + images[0], g + images[1]
        elif images is not None:
            f, g = f + self.attention_to_views(f, images[0]), g + self.attention_to_views(g, images[1])
        for layer in self.layers:
            f, g = layer(f, g)
        f, g = self.last_norm(f), self.last_norm(g)
        match = similarities(self.projection(f), self.projection(g)) * jnp.exp(self.sharpness)
        corresponding = jnp.matmul(nn.softmax(match, axis=-1), y, precision=HIGHEST)
        source_logit, target_logit = self.overlap(f)[..., 0], self.overlap(g)[..., 0]
        weight = nn.sigmoid(source_logit)
        weight = weight / jnp.sum(weight, axis=-1, keepdims=True)
        return Matches(
            source=x,
            target=y,
            match=match,
            corresponding=corresponding,
            source_logit=source_logit,
            target_logit=target_logit,
            weight=weight,
            step=weighted_procrustes(x, corresponding, weight, kernels=self.compute.kernels),
        )


class PatchEncoder(nn.Module):
    """A feature of each patch: shared layers on its points, relative to the centre and beside it, and their maximum."""

    k: int
    widths: tuple[int, ...]
    dim: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, points: Array, index: Array) -> Array:
        """Encode the patches around those of `points [B, N, 3]` that `index [B, K]` names, to `[B, K, dim]`."""
        centre = gather(points, index)
        square = squared_distances(*jax.lax.stop_gradient((centre, points)))
        # With two axes: XLA's CPU compiler has no fast top-k of more.
        neighbours = top_k(-square.reshape(-1, square.shape[-1]), self.k).reshape(*index.shape, self.k)
        offset = (gather(points, neighbours) - centre[:, :, None]) * OFFSET_SCALE
        first, *others = self.widths
        x = Dense(first, compute=self.compute, name="offset")(offset)
        x += Dense(first, use_bias=False, compute=self.compute, name="centre")(centre)[:, :, None]
        for i, width in enumerate(others):
            x = Dense(width, compute=self.compute, name=f"layer_{i}")(nn.relu(x))
        feature = Dense(self.dim, compute=self.compute, name="last")(nn.relu(maximum(x, 2, self.compute.kernels)))
        return (feature + Dense(self.dim, use_bias=False, compute=self.compute, name="position")(centre)).astype(points.dtype)


class PairLayer(nn.Module):
    """A pre-norm layer of attention within each cloud, to the other cloud, and a feed-forward network; the same for both clouds."""

    dim: int
    heads: int
    feed_forward: int
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.norms = [LayerNorm() for _ in range(3)]
        self.own, self.cross = (Attention(self.dim, self.heads, self.compute) for _ in range(2))
        self.hidden = FeedForward(self.feed_forward, self.dim, self.compute, 0.0)

    def __call__(self, f: Array, g: Array) -> tuple[Array, Array]:
        """Map features `[B, K, C]` and `[B, L, C]`."""
        f, g = (x + self.own(y, y) for x, y in ((x, self.norms[0](x)) for x in (f, g)))
        normed = self.norms[1](f), self.norms[1](g)
        f, g = f + self.cross(normed[0], normed[1]), g + self.cross(normed[1], normed[0])
        return f + self.hidden(self.norms[2](f)), g + self.hidden(self.norms[2](g))


def _of_nearest(points: Array, centres: Array, values: Array) -> Array:
    """Give each point `[B, N, 3]` the value `[B, K]` of the nearest centre `[B, K, 3]`."""
    index, _ = jax.vmap(nearest)(points, centres)
    return jnp.take_along_axis(values, index, axis=1)


PATCHES = Model(flags=PatchFlags, build=PatchTransformer, losses=losses)
