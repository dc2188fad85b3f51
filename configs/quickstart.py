"""Generated objects and a small network: minutes on two cores."""

from __future__ import annotations

from dataclasses import replace

from cmig_jax.config import Config, DataConfig, OptimConfig, ViewsConfig
from cmig_jax.models.cmignet.flags import (
    CMIGNetFlags,
    FusionFlags,
    ImageFlags,
    KeypointsFlags,
    LossFlags,
    MatchingFlags,
    PointsFlags,
)
from cmig_jax.models.patches.flags import PatchFlags


def quickstart() -> Config:
    """Train on 20 generated categories, test on the 20 others, with noise and the 75 % crop."""
    return Config(
        name="quickstart",
        data=DataConfig(source="shapes", shapes=40, points=256, categories="first-half", test_categories="second-half"),
        views=ViewsConfig(of="both", count=6, size=32, layout="axes"),
        model=small_network(),
        optim=OptimConfig(learning_rate=2e-3, weight_decay=1e-5, schedule="cosine", epochs=10, batch=16, clip_norm=5.0, validate_every=2),
    )


OWN_CLOUDS = DataConfig(source="shapes", shapes=80, points=512, sampling="twice", crop="independent", turn="either")


def own_clouds() -> Config:
    """The network that comes with the package: generated objects, each cloud sampled and cropped on its own, turned to either side."""
    return Config(
        name="own-clouds",
        data=replace(OWN_CLOUDS, shapes=160, frame="half", noise="uniform", noise_std=0.02, keep_least=0.6),
        model=PatchFlags(),
        optim=OptimConfig(learning_rate=2e-3, weight_decay=0.0, schedule="cosine", epochs=90, batch=16, clip_norm=1.0, validate_every=15),
    )


def own_clouds_cmignet() -> Config:
    """The same data for CMIGNet at a small size, which came with version 0.2."""
    model = small_network()
    return replace(
        quickstart(),
        name="own-clouds-cmignet",
        data=OWN_CLOUDS,
        model=replace(
            model,
            keypoints=replace(model.keypoints, test_count=384),
            matching=replace(model.matching, correspondence="soft"),
        ),
    )


def small_network() -> CMIGNetFlags:
    """128 channels and 64 keypoints; observed views as tokens, each cloud's own linear scores, weighted centroids; at test all points."""
    return CMIGNetFlags(
        points=PointsFlags(k=16, widths=(32, 32, 64, 64), dim=128),
        image=ImageFlags(widths=(16, 32, 64, 128), blocks=(1, 1, 1, 1)),
        fusion=FusionFlags(image="views", feed_forward=256),
        keypoints=KeypointsFlags(count=64, test_count=192),
        matching=MatchingFlags(feature_widths=(64, 32, 32), repeats=5),
        loss=LossFlags(cross_modal="nt-xent", overlap=False, match_mean="positive"),
    )
