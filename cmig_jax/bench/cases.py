"""What is measured: a network, the size of its batch, and inputs that our network and the PyTorch reference read.

All cases are the released CMIGNet, at its own size and smaller.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmig_jax.models.cmignet.flags import CMIGNetFlags, ImageFlags, MatchingFlags, PointsFlags, released
from cmig_jax.parity.cmignet_layout import layout, named_variables
from cmig_jax.parity.inputs import random_pairs
from cmig_jax.parity.weights import named_weights

SEED = 0


@dataclass(frozen=True)
class Case:
    """A network and its batch.

    Attributes:
        flags: of the network.
        pairs, points, views, image_size: B, N, V, H = W.
        images: whether the image encoder is part of the work; otherwise both networks are given random view features.
    """

    flags: CMIGNetFlags
    pairs: int
    points: int
    views: int
    image_size: int
    images: bool = True

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the parts that are also timed alone."""
        return ("point_encoder", "fusion", "scores", "matching", *(("image_encoder",) if self.images else ()))

    def variables(self) -> dict[str, Any]:
        """Return the weights of our network: the reference's."""
        variables = named_variables(self.flags, SEED)
        if self.images:
            return variables
        return {kind: {name: tree for name, tree in flat.items() if name != "views"} for kind, flat in variables.items()}

    def reference(self, device: str) -> Any:
        """Return the reference on `cpu` or `cuda`."""
        from cmig_jax.parity.cmignet_bench import TwinBench

        arrays, state = make_arrays(self), named_weights(layout(self.flags), SEED)
        return TwinBench(self.flags, state, arrays.source, arrays.target, arrays.views, arrays.R, arrays.t, device)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Arrays:
    """Inputs in our layout.

    Attributes:
        source, target: `[B, N, 3]`.
        views: `[B, V, H, W]` uint8 depth, or `[B, C]` features that stand for the image encoder's result.
        R, t: the true pose, `[B, 3, 3]` and `[B, 3]`.
    """

    source: NDArray
    target: NDArray
    views: NDArray
    R: NDArray
    t: NDArray


def _small() -> CMIGNetFlags:
    base = released()
    return replace(
        base,
        points=PointsFlags(k=16, widths=(32, 32, 64, 64), dim=128),
        image=ImageFlags(widths=(16, 32, 64, 128), blocks=(1, 1, 1, 1)),
        fusion=replace(base.fusion, feed_forward=256),
        keypoints=replace(base.keypoints, count=64),
        matching=MatchingFlags(feature_widths=(64, 32, 32)),
    )


def _tiny() -> CMIGNetFlags:
    base = released()
    return replace(
        base,
        points=PointsFlags(k=4, widths=(8, 8), dim=16),
        image=ImageFlags(widths=(4, 16), blocks=(1, 1)),
        fusion=replace(base.fusion, heads=2, feed_forward=16),
        keypoints=replace(base.keypoints, count=16),
        matching=MatchingFlags(iterations=1, feature_widths=(8, 8), coordinate_widths=(8,)),
    )


CASES = {
    "paper": Case(released(), pairs=2, points=768, views=20, image_size=224),
    "points": Case(released(), pairs=2, points=768, views=20, image_size=224, images=False),
    "quickstart": Case(_small(), pairs=16, points=192, views=6, image_size=32),
    "tiny": Case(_tiny(), pairs=2, points=24, views=2, image_size=16),
}


def case_of(name: str) -> Case:
    """Find a case: `paper`, `paper:16` (in batches of 16 pairs) or `points:1:5000` (and of 5,000 points per cloud)."""
    name, *sizes = name.split(":")
    return replace(CASES[name], **dict(zip(("pairs", "points"), map(int, sizes), strict=False)))


def make_arrays(case: Case) -> Arrays:
    """Draw the inputs of a case, always the same."""
    source, target, R, t = random_pairs(SEED, case.pairs, case.points)
    rng, size = np.random.default_rng(SEED), case.image_size
    if case.images:
        coarse = rng.integers(0, 200, (case.pairs, case.views, size // 8 + 1, size // 8 + 1))
        views = coarse.repeat(8, -1).repeat(8, -2)[..., :size, :size] + rng.integers(0, 56, (case.pairs, case.views, size, size))
        views = views.astype(np.uint8)
    else:
        views = rng.random((case.pairs, case.flags.points.dim), np.float32)
    return Arrays(source=source, target=target, views=views, R=R.astype(np.float32), t=t.astype(np.float32))
