"""What a stage is fed: the reference's results in our structures and layout."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import torch
from jax import Array
from numpy.typing import NDArray

from cmig_jax.config import Config
from cmig_jax.nn.cmignet import MATCH_LIMIT
from cmig_jax.nn.keypoints import true_correspondents
from cmig_jax.nn.matching import KeypointSet
from cmig_jax.parity.recorded import Inputs, Run
from cmig_jax.parity.twin_encoders import nearest_neighbors
from cmig_jax.structs import Batch, Iteration, Keypoints, Prediction, RigidTransform

CHANNELS_SECOND = ("feat_src", "feat_tgt", "layer_", "attn_", "svd_src", "svd_corr")


class Reference:
    """The reference's results, rounded to the batch's type, channels last.

    Attributes:
        batch: the pairs.
        prediction: what the network would have returned.
        source, target: the keypoints before they move, with their hybrid features.
    """

    def __init__(self, config: Config, batch: Batch, inputs: Inputs, run: Run) -> None:
        self.batch, self._run, self._k = batch, run, config.model.points.k
        fused = [self[f"feat_{c}"] + self[f"attn_points_{i}"] + self[f"attn_{c}_views_0"] for i, c in enumerate(("src", "tgt"))]
        keypoints = self._keypoints(inputs, config)
        self.source = gather(batch.source, fused[0], keypoints.source_index)
        self.target = gather(batch.target, fused[1], keypoints.target_index)
        self.prediction = Prediction(
            source_features=self["feat_src"],
            target_features=self["feat_tgt"],
            image_features=self["feat_views"][:, None],
            source_fused=fused[0],
            target_fused=fused[1],
            source_scores=self["score_a"],
            target_scores=self["score_b"],
            keypoints=keypoints,
            iterations=tuple(self._iteration(i) for i in range(config.model.matching.iterations)),
            target_from_source=RigidTransform(self["R"], self["t"]),
        )

    def __getitem__(self, name: str) -> Array:
        """Return a result by its recorded name; `it<i>/match` is the whole matching matrix."""
        if name.endswith("/match"):
            return jnp.asarray(self._match(name), self.batch.source.dtype)
        return jnp.asarray(channels_last(name, self._run.outputs[name]), self.batch.source.dtype)

    def cotangent(self, name: str) -> Array:
        """Return the derivative of the loss by a result."""
        return jnp.asarray(channels_last(name, self._run.cotangents[name]), self.batch.source.dtype)

    def graph(self, layer: int) -> Array:
        """Return the neighbours `[2B, N, k]` that edge layer `layer` joins: nearest in what the layer before it gave."""
        if layer > 0:
            features = self._run.outputs[f"layer_{layer - 1}"]
        else:
            features = np.concatenate([np.moveaxis(np.asarray(x, np.float64), 1, 2) for x in (self.batch.source, self.batch.target)])
        return jnp.asarray(nearest_neighbors(torch.from_numpy(features), self._k).numpy(), jnp.int32)

    def _match(self, name: str) -> NDArray:
        return np.clip(self._run.outputs[f"{name}_F"] + self._run.outputs[f"{name}_S"], -MATCH_LIMIT, MATCH_LIMIT)

    def _keypoints(self, inputs: Inputs, config: Config) -> Keypoints:
        if inputs.src_idx is None:
            chosen = (np.argsort(-self._run.outputs[name], axis=1, kind="stable") for name in ("score_a", "score_b"))
            return Keypoints(*(jnp.asarray(index[:, : config.model.keypoints.count]) for index in chosen))
        assert self.batch.target_from_source is not None
        correspondent, label = true_correspondents(
            self.batch.source, self.batch.target, self.batch.target_from_source, config.loss.match_threshold
        )
        index = jnp.asarray(inputs.src_idx, jnp.int32)
        return Keypoints(
            source_index=index,
            target_index=jnp.take_along_axis(correspondent, index, axis=1),
            match_index=jnp.broadcast_to(jnp.arange(index.shape[1]), index.shape),
            match_label=jnp.take_along_axis(label, index, axis=1),
        )

    def _iteration(self, i: int) -> Iteration:
        return Iteration(
            source=self[f"it{i}/svd_src"],
            step=RigidTransform(self[f"it{i}/R"], self[f"it{i}/t"]),
            feature_match=self[f"it{i}/match_F"],
            coordinate_match=self[f"it{i}/match_S"],
            match=self[f"it{i}/match"],
            logit=self[f"it{i}/logit"],
            weight=self[f"it{i}/svd_w"],
            correspondence=jnp.asarray(np.argmax(self._match(f"it{i}/match"), axis=-1)),
            corresponding=self[f"it{i}/svd_corr"],
        )


def gather(points: Array, features: Array, index: Array) -> KeypointSet:
    """Pick keypoints `[B, K]` of `[B, N, 3]` points and `[B, N, C]` features."""
    take = jax.vmap(lambda x, i: x[i])
    return KeypointSet(points=take(points, index), features=take(features, index))


def channels_last(name: str, value: NDArray) -> NDArray:
    """Swap the channels of a result between PyTorch's place and ours (either way), if it has some."""
    return value.swapaxes(1, 2) if name.split("/")[-1].startswith(CHANNELS_SECOND) else value
