"""Correspondence search (Sec. III-E, Fig. 5) and the two heads of Table 8 that stand in for it.

All maps are over pairs of keypoints, source i (rows) and target j (columns). The cmignet head takes one similarity from features
and one from coordinates and adds them; the idam head takes one from both together; the pcrnet head regresses the pose.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.rotations import rotation_from_quaternion
from cmig_jax.nn.mlp import MLP, Dense, NormedMLP, Weights
from cmig_jax.nn.pairs import PairLayer, PairNetwork
from cmig_jax.ops.best_target import best_target
from cmig_jax.ops.pooling import maximum
from cmig_jax.transform import RigidTransform

CREDIBILITY_WIDTH = 32


@struct.dataclass
class Match:
    """Similarities of keypoint pairs `[B, K, K]` (the idam head has no coordinate one), and a credibility logit `[B, K]`."""

    feature: Array
    coordinate: Array | None
    logit: Array


@struct.dataclass
class KeypointSet:
    """Keypoints of one cloud: coordinates `[B, K, 3]`, hybrid features `[B, K, C]`, and maybe `[B, K]` how surely they have a partner."""

    points: Array
    features: Array
    overlap: Array | None = None


class CMIGNetHead(nn.Module):
    """The paper's head: one similarity from features and one from coordinates."""

    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    coordinate_widths: tuple[int, ...] = (32, 32, 32)
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.feature_pairs = PairLayer(self.feature_widths[0], compute=self.compute)
        self.feature_tower = PairNetwork(self.feature_widths, compute=self.compute)
        self.coordinate_pairs = PairLayer(self.coordinate_widths[0], reverse=True, compute=self.compute)
        self.coordinate_tower = PairNetwork(self.coordinate_widths, compute=self.compute)
        self.pre = Weights(2, CREDIBILITY_WIDTH)
        self.credibility = Credibility(self.compute)

    def __call__(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> Match:
        """Match source keypoints to target keypoints."""
        feature, _ = self.feature_tower(self.feature_pairs(source.features, target.features), train=train)
        coordinate, _ = self.coordinate_tower(self.coordinate_pairs(source.points, target.points, source.points), train=train)
        kernel, bias = self.pre()
        assert bias is not None
        pooled = best_target(kernel, bias, feature, coordinate, self.compute)
        return Match(feature=feature, coordinate=coordinate, logit=self.credibility(pooled, train=train))


class IDAMHead(nn.Module):
    """Features and coordinates in one similarity (after Li et al., ECCV 2020)."""

    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.feature_pairs = PairLayer(self.feature_widths[0], compute=self.compute)
        self.coordinate_pairs = PairLayer(self.feature_widths[0], reverse=True, compute=self.compute)
        self.tower = PairNetwork(self.feature_widths, pooled=True, compute=self.compute)
        self.credibility = Credibility(self.compute)

    def __call__(self, source: KeypointSet, target: KeypointSet, *, train: bool) -> Match:
        """Match source keypoints to target keypoints."""
        features = self.feature_pairs(source.features, target.features)
        coordinates = self.coordinate_pairs(source.points, target.points, source.points)
        similarity, pooled = self.tower(features + coordinates, train=train)
        assert pooled is not None
        return Match(feature=similarity, coordinate=None, logit=self.credibility(pooled, train=train))


class PCRNetHead(nn.Module):
    """Regression of the pose from pooled keypoints (after Sarode et al., 2019); no correspondences."""

    width: int = 256
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, source: KeypointSet, target: KeypointSet) -> RigidTransform:
        """Return target_from_source `[B]` for this iteration."""
        encode = MLP((self.width, self.width), compute=self.compute, name="encode")
        encoded = [encode(jnp.concatenate([s.points, s.features], axis=-1)) for s in (source, target)]
        pooled = [maximum(x, 1, self.compute.kernels) for x in encoded]
        pose = MLP((self.width, self.width // 2, 7), compute=self.compute, name="pose")(jnp.concatenate(pooled, axis=-1))
        pose = pose.astype(source.points.dtype)
        upright = jnp.broadcast_to(jnp.array([1, 0, 0, 0], pose.dtype), (*pose.shape[:-1], 4))
        return RigidTransform(R=rotation_from_quaternion(pose[..., :4] + upright), t=pose[..., 4:])


class Credibility(nn.Module):
    """The matching score s(i) before its sigmoid, from a vector that summarises the pairs of a source keypoint."""

    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, pooled: Array, *, train: bool) -> Array:
        """Map `pooled [B, K, C]` to logits `[B, K]`."""
        compute = dataclasses.replace(self.compute, precision="float32")
        hidden = NormedMLP((CREDIBILITY_WIDTH,), compute, name="hidden")(pooled, train=train)
        return Dense(1, compute=compute, name="last")(hidden)[..., 0]
