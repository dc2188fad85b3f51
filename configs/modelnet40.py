"""ModelNet40: the paper's text, the released network, and ours."""

from __future__ import annotations

from dataclasses import replace

from cmig_jax.config import (
    Config,
    DataConfig,
    FusionConfig,
    KeypointsConfig,
    LossConfig,
    MatchingConfig,
    OptimConfig,
    PoseConfig,
    ViewsConfig,
)
from configs.quickstart import quickstart
from configs.scale import at_cpu_scale


def paper() -> Config:
    """The paper's text; where it is silent, the released network."""
    return Config(name="paper")


def released() -> Config:
    """The numbers of the released PyTorch network."""
    base = paper()
    return replace(
        base,
        name="released",
        model=replace(
            base.model,
            fusion=FusionConfig(image="transformer"),
            keypoints=KeypointsConfig(score_from="other", activation="sigmoid"),
            pose=PoseConfig(centroid="unweighted"),
        ),
        loss=LossConfig(overlap="off", overlap_mean="active", cross_modal="nt-xent", credibility_label="index", match_mean="positive"),
    )


def corrected() -> Config:
    """Ours, what measurement supports: observed views as tokens, no predicted keypoints, soft partners; at test all points, repeated."""
    base = released()
    return replace(
        base,
        name="corrected",
        views=ViewsConfig(of="both"),
        model=replace(
            base.model,
            fusion=FusionConfig(image="views"),
            keypoints=KeypointsConfig(select="random", test_count=768),
            matching=MatchingConfig(repeats=5, correspondence="soft"),
        ),
    )


def modelnet40_cpu() -> Config:
    """The network of `quickstart` on ModelNet40: trains on two cores within an hour, on the unseen-category protocol."""
    small = quickstart()
    return replace(
        small,
        name="modelnet40-cpu",
        data=DataConfig(source="modelnet40-hdf5", points=512, categories="first-half", test_categories="second-half"),
        model=replace(small.model, keypoints=replace(small.model.keypoints, test_count=384)),
        optim=OptimConfig(learning_rate=2e-3, weight_decay=1e-5, schedule="cosine", epochs=24, batch=16, clip_norm=5.0, validate_every=4),
    )


def paper_cpu() -> Config:
    """`paper` at the size that the experiments have on two cores: minutes for a training, for comparisons only."""
    return replace(at_cpu_scale(paper()), name="paper-cpu")


def released_cpu() -> Config:
    """`released` at that size."""
    return replace(at_cpu_scale(released()), name="released-cpu")


def corrected_cpu() -> Config:
    """`corrected` at that size."""
    return replace(at_cpu_scale(corrected()), name="corrected-cpu")
