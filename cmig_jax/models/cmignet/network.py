"""CMIGNet (Fig. 2), read top-down: encode, fuse, select keypoints, then n times match and solve for the pose."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.models.cmignet.flags import LOCAL_GROUPS, CMIGNetFlags
from cmig_jax.models.cmignet.heads import CMIGNetHead, IDAMHead, KeypointSet, Match, PCRNetHead
from cmig_jax.models.cmignet.keypoints import (
    SignificanceScore,
    draw_for_training,
    pair_in_order,
    random_points,
    true_correspondents,
)
from cmig_jax.models.cmignet.prediction import CMIGNetPrediction, Iteration, Keypoints
from cmig_jax.models.cmignet.solve import final_correspondences, solve
from cmig_jax.nn.attention import CrossAttention, PairTransformer
from cmig_jax.nn.edgeconv import PointEncoder
from cmig_jax.nn.local_pairs import LocalPairs
from cmig_jax.nn.recompute import call
from cmig_jax.nn.resnet import ViewEncoder
from cmig_jax.ops.neighbours import top_k
from cmig_jax.ops.pooling import maximum
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform


class CMIGNet(nn.Module):
    """Registers X (source) onto Y (target)."""

    flags: CMIGNetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        flags, compute = self.flags, self.compute
        points, image, fusion = flags.points, flags.image, flags.fusion
        self.points = PointEncoder(points.k, points.widths, points.dim, compute)
        if points.local == "pairs":
            self.local = LocalPairs(points.k, points.local_widths, LOCAL_GROUPS, compute)
        if flags.needs.views:
            self.views = ViewEncoder(image.widths, image.blocks, compute)
        if fusion.points == "transformer":
            self.transformer = PairTransformer(points.dim, fusion.heads, fusion.feed_forward, compute)
        if fusion.image in ("cross-attention", "views"):
            self.cross_attention = CrossAttention(points.dim, compute)
        if flags.keypoints.select == "predicted":
            self.score = SignificanceScore(points.dim, flags.keypoints.activation, compute)
        self.heads = tuple(self._head() for _ in range(flags.matching.iterations))

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None, source_index: Array | None = None) -> CMIGNetPrediction:
        """Predict the pose of each pair.

        Args:
            batch: the pairs; `target_from_source` is needed in training, where keypoints are drawn with it.
            train: use batch statistics and the training draw of keypoints, instead of running statistics and the selection.
            key: random key of the draw (training) or of `keypoints.select=random`; fixed if absent in evaluation.
            source_index: `[B, K]` source keypoints to use instead of drawing them (training).

        Raises:
            ValueError: too few points, unequal clouds where the flags need equal ones, or an input that is missing.
        """
        self._check(batch, train, key, source_index)
        local = self.local_features(batch)
        source, target = self.encode(batch.source, batch.target, train, local)
        tokens = self.view_tokens(batch, train)
        fused_source, fused_target = self.fuse(source, target, tokens)
        source_scores, target_scores = self.significance(fused_source, fused_target)
        source_overlap, target_overlap = self._overlap(source_scores), self._overlap(target_scores)
        with jax.named_scope("keypoints"):
            if train:
                keypoints = self._training_keypoints(batch, key, source_index)
            else:
                keypoints = self._keypoints(batch, source_scores, target_scores, key)

        def sets(source: Array, features: tuple[Array, Array]) -> tuple[KeypointSet, KeypointSet]:
            return (
                gather_keypoints(source, features[0], keypoints.source_index, source_overlap),
                gather_keypoints(batch.target, features[1], keypoints.target_index, target_overlap),
            )

        def anew(pose: RigidTransform) -> tuple[KeypointSet, KeypointSet]:
            moved = pose.apply(batch.source)
            return sets(moved, self.fuse(*self.encode(moved, batch.target, train, local), tokens))

        first = sets(batch.source, (fused_source, fused_target))
        iterations, pose = self.iterate(*first, train, anew if self.flags.matching.features == "anew" else None)
        return CMIGNetPrediction(
            target_from_source=pose,
            source_overlap=source_overlap,
            target_overlap=target_overlap,
            correspondences=final_correspondences(keypoints, iterations[-1]),
            source_features=source,
            target_features=target,
            image_features=None if tokens is None else maximum(tokens, 2, self.compute.kernels),
            source_fused=fused_source,
            target_fused=fused_target,
            source_scores=source_scores,
            target_scores=target_scores,
            keypoints=keypoints,
            iterations=iterations,
        )

    def local_features(self, batch: Batch) -> tuple[Array, ...]:
        """Return the local features of both clouds, `[B, N, F]` and `[B, M, F]`, which no motion changes; empty without any.

        Raises:
            ValueError: a cloud without normals.
        """
        if self.flags.points.local == "none":
            return ()
        if batch.source_normals is None or batch.target_normals is None:
            raise ValueError("model.points.local = pairs reads unit normals: expected normals of both clouds, got None")
        return self.local(batch.source, batch.source_normals), self.local(batch.target, batch.target_normals)

    def encode(self, source: Array, target: Array, train: bool, local: tuple[Array, ...] = ()) -> tuple[Array, Array]:
        """Encode both clouds, as one batch if they have equal size: `[B, N, C]`, `[B, M, C]`."""
        if source.shape[1] != target.shape[1]:
            source, target = self.points((source, target), train=train, local=local)
            return source, target

        def joint(first: Array, second: Array) -> Array:
            """Put the two clouds of a pair beside each other, so that each of several devices keeps its own pairs."""
            return jnp.stack([first, second], axis=1).reshape(-1, *first.shape[1:])

        (both,) = self.points((joint(source, target),), train=train, local=(joint(*local),) if local else ())
        features = both.reshape(-1, 2, *both.shape[1:])
        return features[:, 0], features[:, 1]

    def view_tokens(self, batch: Batch, train: bool) -> Array | None:
        """Encode the views to `[B, S, V, C]`; None where nothing reads them, as in evaluation where only a loss does."""
        if not self.flags.needs.views or (not train and self.flags.fusion.image == "none"):
            return None
        if batch.views is None:
            raise ValueError("this network reads images: expected batch.views, got None")
        return batch.views if batch.views.ndim == 4 else self.views(batch.views, train=train)

    def fuse(self, source: Array, target: Array, tokens: Array | None) -> tuple[Array, Array]:
        """Fuse the clouds with each other, then with the images (Sec. III-C); each layer adds to the features."""
        image = self.flags.fusion.image
        if self.flags.fusion.points == "transformer":
            source, target = source + self._call(self.transformer, source, target), target + self._call(self.transformer, target, source)
        if image == "none" or tokens is None:
            return source, target
        if image != "views":
            tokens = jnp.expand_dims(maximum(tokens, 2, self.compute.kernels), 2)  # F_I; N equal tokens act as one
        of_source, of_target = tokens[:, 0].astype(source.dtype), tokens[:, -1].astype(source.dtype)
        layer = self.transformer if image == "transformer" else self.cross_attention
        return source + self._call(layer, source, of_source), target + self._call(layer, target, of_target)

    def significance(self, source: Array, target: Array) -> tuple[Array | None, Array | None]:
        """Score the points of each cloud that its keypoints are selected by (Sec. III-D): `[B, N]`, `[B, M]`."""
        if self.flags.keypoints.select != "predicted":
            return None, None
        pooled_source, pooled_target = (maximum(x, 1, self.compute.kernels) for x in (source, target))
        of_source, of_target = self.score(source, pooled_target), self.score(target, pooled_source)
        return (of_target, of_source) if self.flags.keypoints.score_from == "other" else (of_source, of_target)

    def iterate(
        self,
        source: KeypointSet,
        target: KeypointSet,
        train: bool,
        anew: Callable[[RigidTransform], tuple[KeypointSet, KeypointSet]] | None = None,
    ) -> tuple[tuple[Iteration, ...], RigidTransform]:
        """Match, solve, move the source, n times (Sec. III-E); `anew` returns the keypoints with the features of the moved source."""
        pose = RigidTransform.identity((source.points.shape[0],), source.points.dtype)
        iterations = []
        for i, head in enumerate(self.heads + (() if train else self.heads[-1:] * self.flags.matching.repeats)):
            if anew is not None and 0 < i < len(self.heads):
                source, target = anew(pose)
            if isinstance(head, PCRNetHead):
                iteration = Iteration(source=source.points, step=head(source, target))
            else:
                iteration = self._solve(self._call(head, source, target, train=train), source, target)
            iterations.append(iteration)
            source = dataclasses.replace(source, points=iteration.step.apply(source.points))
            pose = iteration.step.compose(pose)
        return tuple(iterations), pose

    def _head(self) -> CMIGNetHead | IDAMHead | PCRNetHead:
        matching = self.flags.matching
        if matching.head == "pcrnet":
            return PCRNetHead(self.flags.points.dim // 2, self.compute)
        if matching.head == "idam":
            return IDAMHead(matching.feature_widths, self.compute)
        return CMIGNetHead(matching.feature_widths, matching.coordinate_widths, self.compute)

    def _check(self, batch: Batch, train: bool, key: Array | None, source_index: Array | None) -> None:
        chex.assert_rank([batch.source, batch.target], 3)
        N, M, needs = batch.source.shape[1], batch.target.shape[1], self.flags.needs
        if needs.equal_sizes and N != M:
            raise ValueError(f"keypoints.score_from=other scores points by the other cloud's index: expected N = M, got {N} and {M} points")
        fewest = needs.training_points if train else needs.points
        if min(N, M) < fewest:
            raise ValueError(f"expected at least {fewest} points (neighbours, keypoints) in each cloud, got {N} and {M}")
        if train and batch.target_from_source is None:
            raise ValueError("training draws keypoints with the true pose: expected batch.target_from_source, got None")
        if train and key is None and source_index is None and self.flags.keypoints.select != "all":
            raise ValueError("training draws keypoints at random: expected a key or source_index")

    def _call(self, module: nn.Module, *inputs: Any, **options: Any) -> Any:
        return call(module, *inputs, recompute=self.compute.recompute, **options)

    def _overlap(self, scores: Array | None) -> Array | None:
        return nn.sigmoid(scores) if scores is not None and self.flags.keypoints.target == "overlap" else None

    def _keypoints(self, batch: Batch, source_scores: Array | None, target_scores: Array | None, key: Array | None) -> Keypoints:
        (B, N, _), M = batch.source.shape, batch.target.shape[1]
        flags = self.flags.keypoints
        if flags.select == "all":
            return Keypoints(*(jnp.broadcast_to(jnp.arange(n), (B, n)) for n in (N, M)))
        counts = [min(flags.test_count, n) or flags.count for n in (N, M)]
        if flags.select == "random":
            keys = jax.random.split(jax.random.key(0) if key is None else key)
            return Keypoints(*(random_points(k, B, n, count) for k, n, count in zip(keys, (N, M), counts, strict=True)))
        assert source_scores is not None
        assert target_scores is not None
        return Keypoints(top_k(source_scores, counts[0]), top_k(target_scores, counts[1]))

    def _training_keypoints(self, batch: Batch, key: Array | None, source_index: Array | None) -> Keypoints:
        pose, near = batch.target_from_source, self.flags.loss.match_threshold
        assert pose is not None
        correspondent, label = true_correspondents(batch.source, batch.target, pose, near, self.compute.rows)
        if self.flags.keypoints.select == "all":
            every = self._keypoints(batch, None, None, None)
            return dataclasses.replace(every, match_index=correspondent, match_label=label)
        if source_index is None:
            assert key is not None
            source_index = draw_for_training(key, label, self.flags.keypoints.count)
        return pair_in_order(source_index, correspondent, label)

    def _solve(self, match: Match, source: KeypointSet, target: KeypointSet) -> Iteration:
        return solve(match, source, target, self.flags, self.compute.kernels)


def gather_keypoints(points: Array, features: Array, index: Array, overlap: Array | None = None) -> KeypointSet:
    """Select keypoints `[B, K]` of points `[B, N, 3]`, features `[B, N, C]` and overlap scores `[B, N]`."""
    take = jax.vmap(lambda x, i: x[i])
    return KeypointSet(take(points, index), take(features, index), None if overlap is None else take(overlap, index))
