"""CMIGNet (Fig. 2), read top-down: encode, fuse, choose keypoints, then n times match and solve for the pose."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.geometry.maximum import maximum
from cmig_jax.geometry.procrustes import weighted_procrustes
from cmig_jax.nn.attention import PairTransformer
from cmig_jax.nn.edgeconv import PointEncoder
from cmig_jax.nn.fusion import CrossAttention
from cmig_jax.nn.keypoints import SignificanceScore, draw_for_training, pair_in_order, random_points, top_scores, true_correspondents
from cmig_jax.nn.matching import CMIGNetHead, IDAMHead, KeypointSet, Match, PCRNetHead
from cmig_jax.nn.recompute import applied
from cmig_jax.nn.resnet import ViewEncoder
from cmig_jax.structs import Batch, Iteration, Keypoints, Prediction, RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST
MATCH_LIMIT = 20.0  # |M| beyond which the reference clips, so that no softmax saturates


class CMIGNet(nn.Module):
    """Registers X (source) onto Y (target).

    Attributes:
        points: point encoder.
        heads: one correspondence head per iteration.
        views: image encoder, or None where no loss or layer reads images.
        transformer: fusion between the clouds (TF), or None.
        image_fusion: `cross-attention` (Eq. 8), `transformer` (the same weights as between the clouds), `views` (one token per view)
            or `none`.
        cross_attention: the layer of Eq. 8, or None.
        score: significance scores (MP), or None where keypoints are not predicted.
        keypoints: K.
        test_keypoints: K in evaluation, at most all points; 0 is `keypoints`.
        correspondence: a source keypoint's partner is the `hard` best target keypoint, or the `soft` mean of all under the softmax of M.
        repeats: iterations in evaluation beyond those trained, with the weights of the last.
        recompute: whether fusion passes and iterations are computed again for the derivative instead of kept.
    """

    points: PointEncoder
    heads: tuple[CMIGNetHead | IDAMHead | PCRNetHead, ...]
    views: ViewEncoder | None = None
    transformer: PairTransformer | None = None
    image_fusion: Literal["cross-attention", "transformer", "views", "none"] = "none"
    cross_attention: CrossAttention | None = None
    score: SignificanceScore | None = None
    score_from: Literal["own", "other"] = "own"
    select: Literal["predicted", "random", "all"] = "predicted"
    keypoints: int = 256
    test_keypoints: int = 0
    repeats: int = 0
    match_threshold: float = 0.05
    correspondence: Literal["hard", "soft"] = "hard"
    centroid: Literal["weighted", "unweighted"] = "weighted"
    pose_gradient: Literal["stopped", "through"] = "stopped"
    recompute: bool = False
    rows: int = 0

    @nn.compact
    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None, source_index: Array | None = None) -> Prediction:
        """Predict the pose of each pair.

        Args:
            batch: the pairs; `target_from_source` is needed in training, where keypoints are drawn with it.
            train: batch statistics and the training draw of keypoints, instead of running statistics and the selection.
            key: random key of the draw (training) or of `select=random`; fixed if absent in evaluation.
            source_index: `[B, K]` source keypoints to use instead of drawing them (training).
        """
        self._check(batch, train, key, source_index)
        source, target = self._encode(batch.source, batch.target, train)
        tokens = self._view_tokens(batch, train)
        fused_source, fused_target = self._fuse(source, target, tokens)
        source_scores, target_scores = self._scores(fused_source, fused_target)
        with jax.named_scope("keypoints"):
            if train:
                chosen = self._training_keypoints(batch, key, source_index)
            else:
                chosen = self._keypoints(batch, source_scores, target_scores, key)
        iterations, pose = self._register(
            _gather(batch.source, fused_source, chosen.source_index), _gather(batch.target, fused_target, chosen.target_index), train
        )
        return Prediction(
            source_features=source,
            target_features=target,
            image_features=None if tokens is None else maximum(tokens, 2),
            source_fused=fused_source,
            target_fused=fused_target,
            source_scores=source_scores,
            target_scores=target_scores,
            keypoints=chosen,
            iterations=iterations,
            target_from_source=pose,
        )

    def _check(self, batch: Batch, train: bool, key: Array | None, source_index: Array | None) -> None:
        chex.assert_rank([batch.source, batch.target], 3)
        N, M = batch.source.shape[1], batch.target.shape[1]
        if self.score is not None and self.score_from == "other" and N != M:
            raise ValueError(f"score_from=other picks points by the other cloud's index: expected N = M, got {N} and {M} points")
        of_keypoints = 1 if self.select == "all" or (self.test_keypoints and not train) else self.keypoints
        fewest = max(self.points.k, of_keypoints)
        if min(N, M) < fewest:
            raise ValueError(f"expected at least {fewest} points (neighbours, keypoints) in each cloud, got {N} and {M}")
        if train and batch.target_from_source is None:
            raise ValueError("training draws keypoints with the true pose: expected batch.target_from_source, got None")
        if train and key is None and source_index is None and self.select != "all":
            raise ValueError("training draws keypoints at random: expected a key or source_index")

    def _encode(self, source: Array, target: Array, train: bool) -> tuple[Array, Array]:
        """Encode both clouds, as one batch where they have equal size."""
        if source.shape[1] != target.shape[1]:
            source, target = self.points((source, target), train=train)
            return source, target
        # Pair by pair, so that each of several devices keeps its own pairs.
        both = jnp.stack([source, target], axis=1)
        (both_features,) = self.points((both.reshape(-1, *source.shape[1:]),), train=train)
        features = both_features.reshape(*both.shape[:-1], -1)
        return features[:, 0], features[:, 1]

    def _view_tokens(self, batch: Batch, train: bool) -> Array | None:
        """Encode the views to `[B, S, V, C]`; skipped in evaluation where only a loss reads them."""
        if self.views is None or (not train and self.image_fusion == "none"):
            return None
        if batch.views is None:
            raise ValueError("this network reads images: expected batch.views, got None")
        return self.views(batch.views, train=train)

    def _fuse(self, source: Array, target: Array, tokens: Array | None) -> tuple[Array, Array]:
        """Let the clouds see each other, then the images (Sec. III-C); each layer adds to the features."""
        if self.transformer is not None:
            source, target = source + self._layer(self.transformer, source, target), target + self._layer(self.transformer, target, source)
        if self.image_fusion == "none" or tokens is None:
            return source, target
        if self.image_fusion != "views":
            tokens = jnp.expand_dims(maximum(tokens, 2), 2)  # F_I; N equal tokens act as one
        of_source, of_target = tokens[:, 0].astype(source.dtype), tokens[:, -1].astype(source.dtype)
        layer = self.transformer if self.image_fusion == "transformer" else self.cross_attention
        assert layer is not None
        return source + self._layer(layer, source, of_source), target + self._layer(layer, target, of_target)

    def _layer(self, module: nn.Module, *inputs: Any, **flags: Any) -> Any:
        return applied(module, *inputs, recompute=self.recompute, **flags)

    def _scores(self, source: Array, target: Array) -> tuple[Array | None, Array | None]:
        """Score the points that each cloud's keypoints are picked by (Sec. III-D)."""
        if self.score is None:
            return None, None
        of_source, of_target = self.score(source, maximum(target, 1)), self.score(target, maximum(source, 1))
        return (of_target, of_source) if self.score_from == "other" else (of_source, of_target)

    def _keypoints(self, batch: Batch, source_scores: Array | None, target_scores: Array | None, key: Array | None) -> Keypoints:
        (B, N, _), M = batch.source.shape, batch.target.shape[1]
        if self.select == "all":
            every = [jnp.broadcast_to(jnp.arange(n), (B, n)) for n in (N, M)]
            return Keypoints(source_index=every[0], target_index=every[1])
        counts = [min(self.test_keypoints, n) or self.keypoints for n in (N, M)]
        if self.select == "random":
            keys = jax.random.split(jax.random.key(0) if key is None else key)
            return Keypoints(source_index=random_points(keys[0], B, N, counts[0]), target_index=random_points(keys[1], B, M, counts[1]))
        assert source_scores is not None
        assert target_scores is not None
        return Keypoints(source_index=top_scores(source_scores, counts[0]), target_index=top_scores(target_scores, counts[1]))

    def _training_keypoints(self, batch: Batch, key: Array | None, source_index: Array | None) -> Keypoints:
        assert batch.target_from_source is not None
        correspondent, label = true_correspondents(batch.source, batch.target, batch.target_from_source, self.match_threshold, self.rows)
        if self.select == "all":
            every = self._keypoints(batch, None, None, None)
            return dataclasses.replace(every, match_index=correspondent, match_label=label)
        if source_index is None:
            assert key is not None
            source_index = draw_for_training(key, label, self.keypoints)
        return pair_in_order(source_index, correspondent, label)

    def _register(self, source: KeypointSet, target: KeypointSet, train: bool) -> tuple[tuple[Iteration, ...], RigidTransform]:
        """Match, solve, move the source, n times (Sec. III-E)."""
        pose = RigidTransform.identity((source.points.shape[0],), source.points.dtype)
        iterations = []
        for head in self.heads + (() if train else self.heads[-1:] * self.repeats):
            if isinstance(head, PCRNetHead):
                iteration = Iteration(source=source.points, step=head(source, target))
            else:
                iteration = self._solve(self._layer(head, source, target, train=train), source, target)
            iterations.append(iteration)
            source = dataclasses.replace(source, points=iteration.step.apply(source.points))
            pose = iteration.step.compose(pose)
        return tuple(iterations), pose

    def _solve(self, match: Match, source: KeypointSet, target: KeypointSet) -> Iteration:
        """Turn a matching into correspondences, weights (Eq. 10) and a pose (Eq. 11)."""
        total = match.feature if match.coordinate is None else match.feature + match.coordinate
        total = jnp.clip(total, -MATCH_LIMIT, MATCH_LIMIT)
        correspondence = jnp.argmax(total, axis=-1)
        if self.correspondence == "soft":
            corresponding = jnp.matmul(nn.softmax(total, axis=-1), target.points, precision=HIGHEST)
        else:
            corresponding = jnp.take_along_axis(target.points, correspondence[..., None], axis=1)
        weight = credible_half(nn.sigmoid(match.logit))
        step = weighted_procrustes(source.points, corresponding, weight, self.centroid)
        if self.pose_gradient == "stopped":
            step = jax.lax.stop_gradient(step)
        return Iteration(
            source=source.points,
            step=step,
            feature_match=match.feature,
            coordinate_match=match.coordinate,
            match=total,
            logit=match.logit,
            weight=weight,
            correspondence=correspondence,
            corresponding=corresponding,
        )


def credible_half(score: Array) -> Array:
    """Turn scores `[B, K]` into weights that sum to 1, 0 below the lower of the medians (Eq. 10)."""
    K = score.shape[-1]
    median = jnp.sort(jax.lax.stop_gradient(score), axis=-1)[..., (K - 1) // 2, None]
    weight = jnp.where(score >= median, score, 0)
    return weight / (jnp.sum(weight, axis=-1, keepdims=True) + 1e-8)


def _gather(points: Array, features: Array, index: Array) -> KeypointSet:
    take = jax.vmap(lambda x, i: x[i])
    return KeypointSet(points=take(points, index), features=take(features, index))
