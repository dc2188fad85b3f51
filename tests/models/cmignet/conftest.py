"""A tiny CMIGNet with any flags, and pairs for it."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.models.cmignet.flags import CMIGNetFlags, FusionFlags, ImageFlags, KeypointsFlags, LossFlags, MatchingFlags, PointsFlags
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

TINY = CMIGNetFlags(
    points=PointsFlags(k=4, widths=(8, 8), dim=16),
    image=ImageFlags(widths=(4, 16), blocks=(1, 1)),
    fusion=FusionFlags(heads=2, feed_forward=16),
    keypoints=KeypointsFlags(count=32),
    matching=MatchingFlags(iterations=2, feature_widths=(8, 8), coordinate_widths=(8,)),
    loss=LossFlags(overlap=False, cross_modal="off"),
)


@pytest.fixture(scope="session")
def tiny_flags():
    """Return a function from changes by group, such as `fusion={"image": "none"}`, to the flags of a tiny network."""
    return lambda **groups: dataclasses.replace(TINY, **{name: dataclasses.replace(getattr(TINY, name), **x) for name, x in groups.items()})


@pytest.fixture(scope="session")
def pairs():
    """Return a function that draws two pairs of random clouds."""

    def draw(N=70, M=90, sets=1, dtype=np.float64):
        rng = np.random.default_rng(0)
        return Batch(
            target_from_source=RigidTransform(
                R=Rotation.random(2, rng=rng).as_matrix().astype(dtype), t=rng.normal(size=(2, 3)).astype(dtype)
            ),
            source=rng.normal(size=(2, N, 3)).astype(dtype),
            target=rng.normal(size=(2, M, 3)).astype(dtype),
            views=rng.integers(0, 256, (2, sets, 2, 16, 16, 1), dtype=np.uint8),
        )

    return draw
