"""What is measured: a network of the released kind, weights that are a function of a seed, and inputs that both networks read."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cmig_jax.parity.recorded import random_inputs
from cmig_jax.parity.sizes import Sizes


@dataclass(frozen=True)
class Case:
    """One size.

    Attributes:
        sizes: of the network.
        pairs, points, views, image_size: B, N, V, H = W.
        images: whether the image encoder is part of the work; otherwise both networks are given its result.
    """

    sizes: Sizes
    pairs: int
    points: int
    views: int
    image_size: int
    images: bool = True

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages that are timed alone."""
        return ("point_encoder", "fusion", "scores", "matching") + (("image_encoder",) if self.images else ())


@dataclass(frozen=True)
class Arrays:
    """Inputs in our layout.

    Attributes:
        source, target: `[B, N, 3]`.
        views: `[B, V, H, W]` uint8 depth.
        image_features: `[B, C]`, what is given instead of the encoder's result.
        R, t: the true pose.
    """

    source: NDArray
    target: NDArray
    views: NDArray
    image_features: NDArray
    R: NDArray
    t: NDArray


SMALL_NETWORK = Sizes(
    k=16,
    widths=(32, 32, 64, 64),
    dim=128,
    image_widths=(16, 32, 64, 128),
    image_blocks=(1, 1, 1, 1),
    feed_forward=256,
    keypoints=64,
    feature_widths=(64, 32, 32),
)
TINY_NETWORK = Sizes(
    k=4,
    widths=(8, 8),
    dim=16,
    image_widths=(4, 16),
    image_blocks=(1, 1),
    heads=2,
    feed_forward=16,
    keypoints=16,
    iterations=1,
    feature_widths=(8, 8),
    coordinate_widths=(8,),
)
CASES = {
    "paper": Case(Sizes(), pairs=2, points=768, views=20, image_size=224),
    "points": Case(Sizes(), pairs=2, points=768, views=20, image_size=224, images=False),
    "quickstart": Case(SMALL_NETWORK, pairs=16, points=192, views=6, image_size=32),
    "tiny": Case(TINY_NETWORK, pairs=2, points=24, views=2, image_size=16),
}


def case_of(name: str) -> Case:
    """Find a case by its name; `paper:16` is `paper` in batches of 16 pairs."""
    name, _, pairs = name.partition(":")
    return replace(CASES[name], pairs=int(pairs)) if pairs else CASES[name]


def make_arrays(case: Case, seed: int = 0) -> Arrays:
    """Draw the inputs of a case."""
    clouds = random_inputs(seed, case.pairs, case.points, 1, 8)
    rng, size = np.random.default_rng(seed), case.image_size
    coarse = rng.integers(0, 200, (case.pairs, case.views, size // 8 + 1, size // 8 + 1))
    views = coarse.repeat(8, -1).repeat(8, -2)[..., :size, :size] + rng.integers(0, 56, (case.pairs, case.views, size, size))
    return Arrays(
        source=np.ascontiguousarray(clouds.src.swapaxes(1, 2)),
        target=np.ascontiguousarray(clouds.tgt.swapaxes(1, 2)),
        views=views.astype(np.uint8),
        image_features=rng.random((case.pairs, case.sizes.dim), np.float32),
        R=clouds.R_gt.astype(np.float32),
        t=clouds.t_gt.astype(np.float32),
    )
