"""Sizes: `full` is a preset as it is; `at_cpu_scale` makes the same comparison small enough for two cores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cmig_jax.config import Config, OptimConfig
from cmig_jax.models.cmignet.flags import CMIGNetFlags, ImageFlags, PointsFlags


def at_cpu_scale(config: Config) -> Config:
    """Shrink a config to 144 points, 48 keypoints, 128 channels and about 500 steps; what is computed, and from what data, stays."""
    model = config.model
    assert isinstance(model, CMIGNetFlags)
    epochs = 2 if config.data.categories == "all" else 4
    return replace(
        config,
        data=replace(config.data, points=192),
        views=replace(config.views, count=6, size=32, layout="axes"),
        model=replace(
            model,
            points=PointsFlags(k=12, widths=(32, 32, 64, 64), dim=128),
            image=ImageFlags(widths=(16, 32, 64, 128), blocks=(1, 1, 1, 1)),
            fusion=replace(model.fusion, feed_forward=256),
            keypoints=replace(model.keypoints, count=48, test_count=144 if model.keypoints.test_count else 0),
            matching=replace(model.matching, feature_widths=(64, 32, 32)),
        ),
        optim=OptimConfig(learning_rate=2e-3, weight_decay=1e-5, schedule="cosine", epochs=epochs, batch=8, clip_norm=5.0),
    )


def at_toy_scale(config: Config) -> Config:
    """Shrink a config so that a run from end to end takes seconds; its results mean nothing."""
    small = at_cpu_scale(config)
    model = small.model
    assert isinstance(model, CMIGNetFlags)
    return replace(
        small,
        data=replace(small.data, points=32, shapes=4),
        views=replace(small.views, size=8),
        model=replace(
            model,
            points=PointsFlags(k=4, widths=(4, 4), dim=8),
            image=ImageFlags(widths=(4, 8), blocks=(1, 1)),
            fusion=replace(model.fusion, heads=2, feed_forward=8),
            keypoints=replace(model.keypoints, count=8, test_count=24 if model.keypoints.test_count else 0),
            matching=replace(model.matching, feature_widths=(4, 4), coordinate_widths=(4,)),
        ),
        optim=replace(small.optim, epochs=1, batch=2),
    )


SCALES: dict[str, Callable[[Config], Config]] = {"full": lambda config: config, "cpu": at_cpu_scale, "toy": at_toy_scale}
