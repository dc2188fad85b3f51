"""ModelNet40: the paper's text, the released network, and ours."""

from __future__ import annotations

from dataclasses import replace

from cmig_jax.config import Config, DataConfig, OptimConfig, ViewsConfig
from cmig_jax.models.cmignet import flags as cmignet

from .quickstart import quickstart
from .scale import at_cpu_scale


def paper() -> Config:
    """The paper's text; where it is silent, the released network."""
    return Config(name="paper", model=cmignet.paper())


def released() -> Config:
    """The settings of the released PyTorch network."""
    return Config(name="released", model=cmignet.released())


def corrected() -> Config:
    """Ours: observed views as tokens, no predicted keypoints, soft correspondences; at test all points, repeated."""
    return Config(name="corrected", views=ViewsConfig(of="both"), model=cmignet.corrected())


def modelnet40_cpu() -> Config:
    """The network of `quickstart` on ModelNet40: trains on two cores within an hour, on the unseen-category protocol."""
    small = quickstart()
    assert isinstance(small.model, cmignet.CMIGNetFlags)
    return replace(
        small,
        name="modelnet40-cpu",
        data=DataConfig(source="modelnet40-hdf5", points=512, categories="first-half", test_categories="second-half"),
        model=replace(small.model, keypoints=replace(small.model.keypoints, test_count=384)),
        optim=OptimConfig(learning_rate=2e-3, weight_decay=1e-5, schedule="cosine", epochs=24, batch=16, clip_norm=5.0, validate_every=4),
    )


def paper_cpu() -> Config:
    """`paper` at the size of the experiments on two cores: minutes per training, for comparisons only."""
    return replace(at_cpu_scale(paper()), name="paper-cpu")


def released_cpu() -> Config:
    """`released` at that size."""
    return replace(at_cpu_scale(released()), name="released-cpu")


def corrected_cpu() -> Config:
    """`corrected` at that size."""
    return replace(at_cpu_scale(corrected()), name="corrected-cpu")
