"""Noise that fills a volume, such as failed matches and multipath: it belongs to no surface, and hides the fit of those that do."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmig_jax.registration.levels import Level

FIFTH, APART, OFF_SURFACE = 5, 2.5, 0.3
"""A point is scatter if its fifth nearest one is APART times as far as at a quarter of the points or less, and if it, or those around it,
are off a plane by OFF_SURFACE of that distance."""
LEAST, ROUNDS = 0.02, 3
"""Less scatter than the share LEAST is kept, as it harms no fit: clouds of surfaces stay as they are, LiDAR scans too."""
FEWEST = 300
"""The surfaces of a smaller cloud are too sparse to be told from scatter."""


def without_scatter(level: Level) -> Level:
    """Return a cloud without its scatter; the cloud itself where there is little.

    Uniform outliers, as many as the points of a body: 57 to 96 % of them are found, and less than 0.1 % of the body.
    """
    for _ in range(ROUNDS):
        scatter = _scatter(level)
        if len(scatter) < LEAST * len(level.points):
            break
        level = Level(np.delete(level.points, scatter, axis=0))
    return level


def _scatter(level: Level) -> NDArray[np.int64]:
    if len(level.points) < FEWEST:
        return np.zeros(0, np.int64)
    distances, index = level.neighbours
    reach = distances[:, FIFTH]
    apart = np.flatnonzero(reach > APART * np.quantile(reach, 0.25))
    around = level.points[index[apart, 1:]]
    middle = around.mean(axis=1, keepdims=True)
    around = around - middle
    spread, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around) / around.shape[1])
    off = np.abs(np.einsum("ni,ni->n", level.points[apart] - middle[:, 0], axes[:, :, 0]))
    thickness = np.sqrt(spread[:, 0].clip(0))
    return apart[np.maximum(off, thickness) > OFF_SURFACE * reach[apart]]
