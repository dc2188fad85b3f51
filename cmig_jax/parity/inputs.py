"""Random inputs for comparisons and benchmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmig_jax.config import DataConfig
from cmig_jax.data.protocol import make_clouds
from cmig_jax.parity.cases import Arrays


def random_pairs(seed: int, pairs: int, points: int) -> tuple[NDArray, ...]:
    """Make pairs of the paper's protocol from bumpy ellipsoids, with little noise.

    Args:
        seed: of everything.
        pairs, points: B, N.

    Returns:
        Source and target `[B, N, 3]`, R `[B, 3, 3]` and t `[B, 3]`, float32, with `target = R source + t` up to order and noise.
    """
    rng, P = np.random.default_rng(seed), 4 * points // 3 + 1
    data = DataConfig(points=P, keep=points / P, noise_std=0.005, noise_clip=0.02)
    clouds = [make_clouds(_ellipsoid(rng, P), data, "ellipsoid", rng) for _ in range(pairs)]
    return tuple(np.stack([cloud[name] for cloud in clouds]) for name in ("source", "target", "R", "t"))


def random_inputs(seed: int, pairs: int, points: int, views: int, size: int) -> Arrays:
    """Make the inputs of a case: random pairs, and smooth random images of `size` x `size` pixels, `views` per pair.

    Returns:
        `src`, `tgt` `[B, 3, N]`, `views` `[B, V, 3, H, W]`, `R_gt` `[B, 3, 3]`, `t_gt` `[B, 3]`.
    """
    (source, target, R, t), rng = random_pairs(seed, pairs, points), np.random.default_rng(seed)
    coarse = rng.standard_normal((pairs, views, 3, size // 8 + 1, size // 8 + 1)).repeat(8, -1).repeat(8, -2)[..., :size, :size]
    images = (coarse + 0.3 * rng.standard_normal(coarse.shape)).astype(np.float32)
    return {"src": source.swapaxes(1, 2), "tgt": target.swapaxes(1, 2), "views": images, "R_gt": R, "t_gt": t}


def _ellipsoid(rng: np.random.Generator, points: int) -> NDArray:
    direction = rng.standard_normal((points, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    bumps = 1 + 0.2 * np.sin(direction @ rng.uniform(2, 5, (3, 3))).sum(axis=1, keepdims=True) / 3
    return direction * bumps * rng.uniform(0.4, 1, 3)
