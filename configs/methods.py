"""The learned methods that CMIGNet is compared with: each with the protocol and the training of its paper or released code.

Where the two differ, the released code's values are used. `cmig_jax/models/<network>.py` says what each computes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cmig_jax.config import Config, DataConfig, OptimConfig
from cmig_jax.data.protocol import SYMMETRIC
from cmig_jax.models.dcp.flags import DCPFlags
from cmig_jax.models.finet.flags import FINetFlags
from cmig_jax.models.idam.flags import IDAMFlags
from cmig_jax.models.masknet.flags import MaskNetFlags
from cmig_jax.models.omnet.flags import OMNetFlags
from cmig_jax.models.pcrnet.flags import PCRNetFlags
from cmig_jax.models.pointnetlk.flags import PointNetLKFlags, revisited
from cmig_jax.models.prnet.flags import PRNetFlags
from cmig_jax.models.rpmnet.flags import RPMNetFlags

from .scale import at_cpu_scale

COMPLETE = DataConfig(crop="none", noise_std=0.0)
TWISTS = replace(COMPLETE, pose="twist", max_twist=0.8, categories="first-half", test_categories="second-half")


def pointnetlk() -> Config:
    """PointNetLK (Aoki et al., CVPR 2019), without the classifier that its encoder was first trained as."""
    optim = OptimConfig(learning_rate=1e-3, weight_decay=0.0, milestones=(), epochs=400, batch=32)
    return Config(name="pointnetlk", data=TWISTS, model=PointNetLKFlags(), optim=optim)


def pointnetlk_revisited() -> Config:
    """PointNetLK Revisited (Li et al., CVPR 2021): analytic Jacobian, a smaller encoder, 100 points at a time in training."""
    optim = OptimConfig(learning_rate=1e-3, weight_decay=1e-4, milestones=(), epochs=200, batch=32)
    return Config(name="pointnetlk-revisited", data=replace(TWISTS, points=1000), model=revisited(), optim=optim)


def dcp() -> Config:
    """DCP v2 (Wang and Solomon, ICCV 2019): complete clouds, soft partners, the transformer."""
    optim = OptimConfig(learning_rate=1e-3, weight_decay=1e-4, milestones=(75, 150, 200), decay=0.1, epochs=250, batch=32)
    return Config(name="dcp", data=COMPLETE, model=DCPFlags(), optim=optim)


def dcp_v1() -> Config:
    """DCP v1: without the transformer."""
    return replace(dcp(), name="dcp-v1", model=DCPFlags(pointer="identity"))


def prnet() -> Config:
    """PRNet (Wang and Solomon, NeurIPS 2019): partial clouds, keypoints, partners drawn with Gumbel noise."""
    optim = OptimConfig(learning_rate=1e-3, weight_decay=1e-4, milestones=(30, 60, 80), decay=0.1, epochs=100, batch=36)
    return Config(name="prnet", data=DataConfig(noise_std=0.0), model=PRNetFlags(), optim=optim)


def idam() -> Config:
    """IDAM with its graph network (Li et al., ECCV 2020)."""
    optim = OptimConfig(learning_rate=1e-4, weight_decay=1e-3, milestones=(30,), decay=0.1, epochs=40, batch=16)
    return Config(name="idam", data=DataConfig(noise_std=0.0), model=IDAMFlags(), optim=optim)


def rpmnet() -> Config:
    """RPM-Net (Yew and Lee, CVPR 2020): normals, a half-space crop of each cloud, noise, unseen categories."""
    data = DataConfig(sampling="subsets", crop="half-space", keep=0.7, categories="first-half", test_categories="second-half")
    optim = OptimConfig(learning_rate=1e-4, weight_decay=0.0, milestones=(), epochs=1000, batch=8)
    return Config(name="rpmnet", data=data, model=RPMNetFlags(), optim=optim)


def pcrnet() -> Config:
    """Iterative PCRNet (Sarode et al., 2019): complete clouds turned to either side, each object by one pose throughout (released code)."""
    data = replace(COMPLETE, turn="either", max_translation=1.0, pose_of="each-object")
    optim = OptimConfig(learning_rate=1e-3, weight_decay=0.0, milestones=(), epochs=200, batch=20)
    return Config(name="pcrnet", data=data, model=PCRNetFlags(), optim=optim)


def masknet() -> Config:
    """MaskNet (Sarode et al., 3DV 2020): a complete target masked for a cropped source, then ICP; noise up to 0.04 (released code)."""
    data = replace(TWISTS, crop="source", noise_std=0.04, noise="uniform")
    optim = OptimConfig(learning_rate=1e-4, weight_decay=0.0, milestones=(), epochs=500, batch=32)
    return Config(name="masknet", data=data, model=MaskNetFlags(), optim=optim)


def omnet() -> Config:
    """OMNet (Xu et al., ICCV 2021): overlap masks and a regressed pose; asymmetric categories, sampled independently, with noise."""
    data = DataConfig(sampling="twice", exclude=SYMMETRIC)
    optim = OptimConfig(learning_rate=1e-4, weight_decay=0.0, milestones=(), epochs=4000, batch=64, validate_every=20)
    return Config(name="omnet", data=data, model=OMNetFlags(), optim=optim)


def finet() -> Config:
    """FINet (Xu et al., AAAI 2022): branches for rotation and translation; RPM-Net's crop, sampled independently, with noise."""
    data = DataConfig(sampling="twice", crop="half-space", keep=0.7, exclude=SYMMETRIC)
    optim = OptimConfig(learning_rate=1e-4, weight_decay=0.0, milestones=(), epochs=10000, batch=64, validate_every=20)
    return Config(name="finet", data=data, model=FINetFlags(), optim=optim)


_PRESETS = (pointnetlk, pointnetlk_revisited, dcp, dcp_v1, prnet, idam, rpmnet, pcrnet, masknet, omnet, finet)


def _small(preset: Callable[[], Config]) -> Callable[[], Config]:
    """Return a preset at the size of the experiments on two cores."""

    def small() -> Config:
        config = preset()
        return replace(at_cpu_scale(config), name=f"{config.name}-cpu")

    small.__doc__ = f"`{preset().name}` at the size of the experiments on two cores: minutes per training, for comparisons only."
    return small


METHODS: dict[str, Callable[[], Config]] = {
    name: make for preset in _PRESETS for name, make in ((preset().name, preset), (f"{preset().name}-cpu", _small(preset)))
}
