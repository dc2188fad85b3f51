"""CMIGNet as the rest of the package sees it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from cmig_jax.models.base import Model, predict
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.models.cmignet.losses import losses
from cmig_jax.models.cmignet.network import CMIGNet, gather_keypoints
from cmig_jax.structs import Batch


def stages(network: Any, variables: Any, batch: Batch, train: bool) -> dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]:
    """Return the parts that a benchmark times, each with what the part before gives it in evaluation."""
    prediction: Any = predict(network, variables, batch)
    fused, keypoints = (prediction.source_fused, prediction.target_fused), prediction.keypoints
    tokens = None if prediction.image_features is None else jnp.expand_dims(prediction.image_features, 2)
    sets = (
        gather_keypoints(batch.source, fused[0], keypoints.source_index),
        gather_keypoints(batch.target, fused[1], keypoints.target_index),
    )
    parts: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        "point_encoder": (lambda m: m.encode(batch.source, batch.target, train, m.local_features(batch)), ()),
        "fusion": (lambda m, *x: m.fuse(*x), (prediction.source_features, prediction.target_features, tokens)),
        "scores": (lambda m, *x: m.significance(*x), fused),
        "matching": (lambda m, *x: [y for i in m.iterate(*x, train)[0] for y in (i.match, i.logit)], sets),
    }
    if batch.views is not None and batch.views.ndim > 4:
        parts["image_encoder"] = (lambda m: m.view_tokens(batch, train), ())
    return parts


CMIGNET = Model(flags=CMIGNetFlags, build=CMIGNet, losses=losses, stages=stages)
