"""Sizes of the released network, and the flags that describe a network of these sizes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from cmig_jax.config import Config, ModelConfig
from configs import modelnet40 as presets

CREDIBILITY_WIDTH = 32


@dataclass(frozen=True)
class Sizes:
    """Sizes of the network; the defaults are the released ones."""

    k: int = 20
    widths: tuple[int, ...] = (64, 64, 64, 128)
    dim: int = 512
    image_widths: tuple[int, ...] = (64, 128, 256, 512)
    image_blocks: tuple[int, ...] = (2, 2, 2, 2)
    heads: int = 4
    feed_forward: int = 1024
    keypoints: int = 256
    iterations: int = 3
    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    coordinate_widths: tuple[int, ...] = (32, 32, 32)


SMALL = Sizes(
    k=6,
    widths=(8, 8, 16),
    dim=32,
    image_widths=(8, 16, 32),
    image_blocks=(1, 2, 1),
    heads=2,
    feed_forward=48,
    keypoints=24,
    iterations=2,
    feature_widths=(16, 8),
    coordinate_widths=(8, 8),
)


def released(sizes: Sizes | None = None, margins: tuple[float, float] | None = None) -> Config:
    """Return the `released` preset with these sizes; margins turn the overlap loss on."""
    s, base = sizes or Sizes(), presets.released()
    m, needed = base.model, math.ceil((sizes or Sizes()).keypoints / base.data.keep) + 1
    return replace(
        base,
        data=replace(base.data, points=max(base.data.points, needed)),
        model=replace(
            m,
            points=replace(m.points, k=s.k, widths=s.widths, dim=s.dim),
            image=replace(m.image, widths=s.image_widths, blocks=s.image_blocks),
            fusion=replace(m.fusion, heads=s.heads, feed_forward=s.feed_forward),
            keypoints=replace(m.keypoints, count=s.keypoints),
            matching=replace(m.matching, iterations=s.iterations, feature_widths=s.feature_widths, coordinate_widths=s.coordinate_widths),
        ),
        loss=base.loss if margins is None else replace(base.loss, overlap="on", margins=margins),
    )


def sizes_of(model: ModelConfig) -> Sizes:
    """Read the sizes off the flags of a network."""
    return Sizes(
        k=model.points.k,
        widths=model.points.widths,
        dim=model.points.dim,
        image_widths=model.image.widths,
        image_blocks=model.image.blocks,
        heads=model.fusion.heads,
        feed_forward=model.fusion.feed_forward,
        keypoints=model.keypoints.count,
        iterations=model.matching.iterations,
        feature_widths=model.matching.feature_widths,
        coordinate_widths=model.matching.coordinate_widths,
    )
