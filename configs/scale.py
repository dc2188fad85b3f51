"""Scales: `full` is a preset as it is; `at_cpu_scale` makes the same comparison small enough for two cores."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cmig_jax.config import Config, OptimConfig

from .sizes import cpu_size, toy_size


def at_cpu_scale(config: Config) -> Config:
    """Shrink a config to 192 points before the crop and about 500 steps of 8 pairs; what is computed, and from what data, stays."""
    epochs = 2 if config.data.categories == "all" else 4
    return replace(
        config,
        data=replace(config.data, points=192),
        views=replace(config.views, count=6, size=32, layout="axes"),
        model=cpu_size(config.model),
        optim=OptimConfig(learning_rate=2e-3, weight_decay=1e-5, schedule="cosine", epochs=epochs, batch=8, clip_norm=5.0),
    )


def at_long_cpu_scale(config: Config) -> Config:
    """Train the networks of `cpu` on ten times the pairs, in larger batches: a quarter of an hour on two cores, a minute on a GPU."""
    small = at_cpu_scale(config)
    return replace(small, optim=replace(small.optim, epochs=10 * small.optim.epochs, batch=32, validate_every=5))


def at_toy_scale(config: Config) -> Config:
    """Shrink a config so that a run from end to end takes seconds; its results mean nothing."""
    small = at_cpu_scale(config)
    return replace(
        small,
        data=replace(small.data, points=32, shapes=4),
        views=replace(small.views, size=8),
        model=toy_size(config.model),
        optim=replace(small.optim, epochs=1, batch=2),
    )


def shortened(config: Config) -> Config:
    """Train for a fifth of the epochs and change nothing else: of the small presets, minutes on two cores."""
    return replace(config, optim=replace(config.optim, epochs=max(1, config.optim.epochs // 5)))


SCALES: dict[str, Callable[[Config], Config]] = {
    "full": lambda config: config,
    "cpu": at_cpu_scale,
    "cpu-long": at_long_cpu_scale,
    "short": shortened,
    "toy": at_toy_scale,
}
