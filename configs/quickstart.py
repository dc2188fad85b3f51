"""Generated objects and a small network: minutes on two cores."""

from __future__ import annotations

from dataclasses import replace

from cmig_jax.config import (
    Config,
    DataConfig,
    FusionConfig,
    ImageConfig,
    KeypointsConfig,
    LossConfig,
    MatchingConfig,
    ModelConfig,
    OptimConfig,
    PointsConfig,
    ViewsConfig,
)


def quickstart() -> Config:
    """Train on 20 generated categories, test on the 20 others, with noise and the 75 % crop."""
    return Config(
        name="quickstart",
        data=DataConfig(source="shapes", shapes=40, points=256, categories="first-half", test_categories="second-half"),
        views=ViewsConfig(of="both", count=6, size=32, layout="axes"),
        model=small_network(),
        loss=LossConfig(cross_modal="nt-xent", overlap="off", match_mean="positive"),
        optim=OptimConfig(learning_rate=2e-3, weight_decay=1e-5, schedule="cosine", epochs=10, batch=16, clip_norm=5.0, validate_every=2),
    )


def own_clouds() -> Config:
    """The network that comes with the package: generated objects, each cloud sampled and cropped on its own, turned to either side."""
    base = quickstart()
    model = small_network()
    return replace(
        base,
        name="own-clouds",
        data=DataConfig(source="shapes", shapes=80, points=512, sampling="twice", crop="independent", turn="either"),
        model=replace(
            model,
            keypoints=replace(model.keypoints, test_count=384),
            matching=replace(model.matching, correspondence="soft"),
        ),
    )


def small_network() -> ModelConfig:
    """128 channels and 64 keypoints; observed views as tokens, each cloud's own linear scores, weighted centroids; at test all points."""
    return ModelConfig(
        points=PointsConfig(k=16, widths=(32, 32, 64, 64), dim=128),
        image=ImageConfig(widths=(16, 32, 64, 128), blocks=(1, 1, 1, 1)),
        fusion=FusionConfig(image="views", feed_forward=256),
        keypoints=KeypointsConfig(count=64, test_count=192),
        matching=MatchingConfig(feature_widths=(64, 32, 32), repeats=5),
    )
