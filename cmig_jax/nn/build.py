"""Flags to network: the one place where modules meet the config."""

from __future__ import annotations

import jax.numpy as jnp

from cmig_jax.config import Config
from cmig_jax.nn.attention import PairTransformer
from cmig_jax.nn.cmignet import CMIGNet
from cmig_jax.nn.edgeconv import PointEncoder
from cmig_jax.nn.fusion import CrossAttention
from cmig_jax.nn.keypoints import SignificanceScore
from cmig_jax.nn.matching import CMIGNetHead, IDAMHead, PCRNetHead
from cmig_jax.nn.resnet import ViewEncoder


def build(config: Config) -> CMIGNet:
    """Build the network that the flags describe."""
    m = config.model
    dim, rows = m.points.dim, config.compute.rows
    dtype = jnp.bfloat16 if config.compute.precision == "bfloat16" else None
    image, recompute = m.fusion.image, config.compute.recompute == "on"
    return CMIGNet(
        points=PointEncoder(m.points.k, m.points.widths, dim, rows=rows, dtype=dtype),
        heads=tuple(_head(config, dtype) for _ in range(m.matching.iterations)),
        views=ViewEncoder(m.image.widths, m.image.blocks, recompute, dtype) if uses_images(config) else None,
        transformer=(
            PairTransformer(dim, m.fusion.heads, m.fusion.feed_forward, rows=rows, dtype=dtype)
            if m.fusion.points == "transformer"
            else None
        ),
        image_fusion=image,
        cross_attention=CrossAttention(dim, rows=rows, dtype=dtype) if image in ("cross-attention", "views") else None,
        score=SignificanceScore(dim, m.keypoints.activation, dtype=dtype) if m.keypoints.select == "predicted" else None,
        score_from=m.keypoints.score_from,
        select=m.keypoints.select,
        repeats=m.matching.repeats,
        keypoints=m.keypoints.count,
        test_keypoints=m.keypoints.test_count,
        match_threshold=config.loss.match_threshold,
        correspondence=m.matching.correspondence,
        centroid=m.pose.centroid,
        pose_gradient=m.pose.gradient,
        recompute=recompute,
        rows=rows,
    )


def uses_images(config: Config) -> bool:
    """Say whether a layer or a loss reads images."""
    return config.model.fusion.image != "none" or config.loss.cross_modal != "off"


def _head(config: Config, dtype: jnp.dtype | None) -> CMIGNetHead | IDAMHead | PCRNetHead:
    matching, rows = config.model.matching, config.compute.rows
    if matching.head == "pcrnet":
        return PCRNetHead(width=config.model.points.dim // 2, dtype=dtype)
    if matching.head == "idam":
        return IDAMHead(matching.feature_widths, rows=rows, dtype=dtype)
    return CMIGNetHead(matching.feature_widths, matching.coordinate_widths, rows=rows, dtype=dtype)
