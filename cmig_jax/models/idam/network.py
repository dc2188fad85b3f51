"""IDAM: similarities of keypoints from features and coordinates together, a pose from the credible half of them, three times.

Section numbers are those of Li et al., ECCV 2020. The features of the graph network are computed once; the iterations move only the
coordinates.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import pair_distances
from cmig_jax.models.base import Model
from cmig_jax.models.cmignet import losses as shared
from cmig_jax.models.cmignet.flags import LossFlags
from cmig_jax.models.cmignet.heads import KeypointSet
from cmig_jax.models.cmignet.keypoints import draw_for_training, pair_in_order, true_correspondents
from cmig_jax.models.cmignet.network import gather_keypoints
from cmig_jax.models.cmignet.prediction import Iteration, Keypoints, MatchingPrediction
from cmig_jax.models.cmignet.solve import credible_half
from cmig_jax.models.idam.flags import IDAMFlags
from cmig_jax.nn.mlp import Dense, NormedMLP, Weights
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.ops.edges import gather
from cmig_jax.ops.neighbours import knn, top_k
from cmig_jax.ops.pooling import maximum
from cmig_jax.ops.procrustes import weighted_procrustes
from cmig_jax.structs import Batch, Correspondences
from cmig_jax.transform import RigidTransform

MATCH_LIMIT = 20.0


@struct.dataclass(kw_only=True)
class IDAMPrediction(MatchingPrediction):
    """What the network returns."""


class IDAMNetwork(nn.Module):
    """Registers the source onto the target."""

    flags: IDAMFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        flags, compute = self.flags, self.compute
        self.graph_layers = [GraphLayer(flags.dim, compute) for _ in range(flags.layers)]
        self.significance = Significance(flags.significance_widths, compute)
        self.matchers = [Matcher(flags.dim, flags.pair_width, compute) for _ in range(flags.iterations)]

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None, source_index: Array | None = None) -> IDAMPrediction:
        """Predict the pose of each pair.

        Args:
            batch: the pairs; in training with their true poses.
            train: normalise with batch statistics, and draw keypoints.
            key: of that draw.
            source_index: `[B, K]` source keypoints of a training pass, instead of a draw.

        Raises:
            ValueError: too few points, or in training no pose, or neither `key` nor `source_index`.
        """
        self._check(batch)
        target_features = self.encode(batch.target, train)  # the released code's order, which running statistics depend on
        source_features = self.encode(batch.source, train)
        source_scores, target_scores = self.significance(source_features, train=train), self.significance(target_features, train=train)
        K = batch.source.shape[1] // self.flags.points_per_keypoint
        if train:
            keypoints = self.training_keypoints(batch, K, key, source_index)
        else:
            keypoints = Keypoints(top_k(source_scores, K), top_k(target_scores, min(K, batch.target.shape[1])))
        source = gather_keypoints(batch.source, source_features, keypoints.source_index)
        target = gather_keypoints(batch.target, target_features, keypoints.target_index)
        iterations, pose = self.iterate(source, target, train)
        last = iterations[-1]
        assert last.correspondence is not None
        assert last.weight is not None
        return IDAMPrediction(
            target_from_source=pose,
            correspondences=Correspondences(keypoints.source_index, keypoints.target_index, last.correspondence, last.weight),
            keypoints=keypoints,
            iterations=iterations,
            source_scores=source_scores,
            target_scores=target_scores,
        )

    def encode(self, points: Array, train: bool) -> Array:
        """Encode a cloud `[B, N, 3]` to `[B, N, C]`: layers on one graph of its coordinates (Sec. 4)."""
        graph, features = knn(points, self.flags.k, self.compute), points
        for layer in self.graph_layers:
            features = layer(features, graph, train=train)
        return features

    def training_keypoints(self, batch: Batch, count: int, key: Array | None, source_index: Array | None) -> Keypoints:
        """Draw source keypoints, half of them with a correspondent; those of the target are their nearest points (Sec. 3.5)."""
        if batch.target_from_source is None or (key is None and source_index is None):
            raise ValueError("training draws keypoints with the true pose: expected batch.target_from_source, and a key or source_index")
        correspondent, label = self.correspondents(batch.source, batch.target, batch.target_from_source)
        if source_index is None:
            assert key is not None
            source_index = draw_for_training(key, label, count)
        return pair_in_order(source_index, correspondent, label)

    def correspondents(self, source: Array, target: Array, pose: RigidTransform) -> tuple[Array, Array]:
        """Return for each source point its nearest target point under the true pose, and 1 where the two correspond: `[B, N]` each."""
        return true_correspondents(source, target, pose, self.flags.match_threshold, self.compute.rows)

    def iterate(self, source: KeypointSet, target: KeypointSet, train: bool) -> tuple[tuple[Iteration, ...], RigidTransform]:
        """Match, solve, move the source keypoints, n times (Sec. 3.2)."""
        pose, iterations = RigidTransform.identity((source.points.shape[0],), source.points.dtype), []
        for matcher in self.matchers:
            iteration = self.solve(source.points, target.points, *matcher(source, target, train=train))
            iterations.append(iteration)
            source = dataclasses.replace(source, points=iteration.step.apply(source.points))
            pose = iteration.step.compose(pose)
        return tuple(iterations), pose

    def solve(self, source: Array, target: Array, match: Array, logit: Array) -> Iteration:
        """Turn similarities into correspondences, their weights and a pose (Sec. 3.4); the pose carries no gradient."""
        match = jnp.clip(match, -MATCH_LIMIT, MATCH_LIMIT)
        correspondence = jnp.argmax(match, axis=-1)
        corresponding = jnp.take_along_axis(target, correspondence[..., None], axis=1)
        weight = credible_half(nn.sigmoid(logit))
        step = jax.lax.stop_gradient(weighted_procrustes(source, corresponding, weight, "unweighted", self.compute.kernels))
        return Iteration(
            source=source,
            step=step,
            match=match,
            logit=logit,
            weight=weight,
            correspondence=correspondence,
            corresponding=corresponding,
        )

    def _check(self, batch: Batch) -> None:
        N, M, fewest = batch.source.shape[1], batch.target.shape[1], self.flags.needs.points
        if min(N, M) < fewest:
            raise ValueError(f"expected at least {fewest} points (neighbours, keypoints) in each cloud, got {N} and {M}")


class GraphLayer(nn.Module):
    """A layer on the differences from neighbours: two layers for each edge, the maximum over the neighbours, a layer for each point."""

    features: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, x: Array, graph: Array, *, train: bool) -> Array:
        """Map `x [B, N, C]` with neighbours `[B, N, k]` to `[B, N, features]`."""
        # A linear layer on x_j - x_i is the difference of its values at both: N products instead of N k.
        projected = Dense(self.features, use_bias=False, compute=self.compute, name="edge_first")(x)
        edges = gather(projected, graph) - projected[:, :, None]
        edges = nn.relu(BatchNorm(self.features, self.compute, name="edge_norm")(edges, train=train))
        edges = Dense(self.features, compute=self.compute, name="edge_last")(edges)
        return Dense(self.features, compute=self.compute, name="point")(maximum(edges, 2, self.compute.kernels)).astype(x.dtype)


class Significance(nn.Module):
    """Scores the points of a cloud."""

    widths: tuple[int, ...]
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, features: Array, *, train: bool) -> Array:
        """Score `features [B, N, C]`, to `[B, N]`."""
        hidden = NormedMLP(self.widths, self.compute, name="hidden")(features, train=train)
        return Dense(1, compute=self.compute, name="last")(hidden)[..., 0].astype(features.dtype)


class Matcher(nn.Module):
    """Similarities of all pairs of keypoints, from features, distances and directions (Sec. 3.2), and validities of the source's."""

    dim: int
    width: int
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        compute, width = self.compute, self.width
        self.first = Weights(2 * self.dim + 4, width, use_bias=False)
        self.first_norm = BatchNorm(width, compute)
        self.last = Dense(width, compute=compute)
        self.match_hidden, self.match_last = NormedMLP((width,), compute), Dense(1, compute=compute)
        self.logit_hidden, self.logit_last = NormedMLP((width,), compute), Dense(1, compute=compute)

    def __call__(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> tuple[Array, Array]:
        """Return similarities `[B, K, L]` and logits of the validity `[B, K]`."""
        pairs = self.pairs(source, target, train)
        match = self.match_last(self.match_hidden(pairs, train=train))[..., 0]
        logit = self.logit_last(self.logit_hidden(self.best(pairs), train=train))[..., 0]
        dtype = source.points.dtype
        return match.astype(dtype), logit.astype(dtype)

    def pairs(self, source: KeypointSet, target: KeypointSet, train: bool) -> Array:
        """Return the features of all pairs, `[B, K, L, width]`: a layer on both features, the distance and the direction, and another."""
        C = self.dim
        own, other, length, direction = jnp.split(self.first()[0], (C, 2 * C, 2 * C + 1))
        distance = pair_distances(source.points, target.points)[..., None]
        offset = source.points[:, :, None] - target.points[:, None]
        features = (source.features @ own)[:, :, None] + (target.features @ other)[:, None]
        values = features + distance @ length + (offset / (distance + 1e-8)) @ direction
        return self.last(nn.relu(self.first_norm(values, train=train)))

    def best(self, pairs: Array) -> Array:
        """Return the maximum of `[B, K, L, width]` over the targets."""
        return maximum(pairs, 2, self.compute.kernels)


def losses(prediction: IDAMPrediction, batch: Batch, flags: IDAMFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return `mask`, and `matching_<i>` and `credibility_<i>` of each iteration (Sec. 3.5)."""
    del compute
    loss = LossFlags(match_threshold=flags.match_threshold, credibility_label=flags.credibility_label, match_mean="positive")
    assert batch.target_from_source is not None
    terms = {"mask": 2 * shared.mask(prediction)}  # not halved, as CMIGNet's is
    for i, iteration in enumerate(prediction.iterations):
        terms[f"matching_{i}"] = shared.matching(prediction, iteration, loss)
        terms[f"credibility_{i}"] = shared.credibility(prediction, iteration, batch.source, batch.target_from_source, loss)
    return terms


IDAM = Model(flags=IDAMFlags, build=IDAMNetwork, losses=losses)
