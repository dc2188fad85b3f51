"""Noise that fills a volume is left out, and surfaces stay, however its density varies."""

import numpy as np
import pytest

from cmig_jax.registration.levels import Level
from cmig_jax.registration.scatter import FEWEST, without_scatter


def sheet(count, seed, density=1.0):
    """Points on a curved sheet, the more the larger `density` towards one side."""
    x, y = np.random.default_rng(seed).uniform(-1, 1, (2, count))
    x = np.sign(x) * np.abs(x) ** density
    return np.stack([x, y, 0.3 * np.sin(3 * x) + 0.2 * y**2], axis=1)


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("size", [1.0, 3.0])
def test_uniform_outliers_are_left_out_and_the_surface_stays(share, size):
    surface = sheet(1_000, 0)
    noise = np.random.default_rng(1).uniform(-size, size, (int(share * 1_000), 3))
    left = {tuple(point) for point in without_scatter(Level(np.concatenate([surface, noise]))).points}
    assert len(left & set(map(tuple, surface))) >= 998
    assert len(left & set(map(tuple, noise))) < 0.5 * len(noise)


@pytest.mark.parametrize("density", [1.0, 3.0, 6.0])
def test_a_surface_stays_as_it_is(density):
    """At density 6, the fifth neighbours of a tenth of the points are more than 20 times as far as those of another tenth."""
    for level in (Level(sheet(2_000, 2, density)), Level(sheet(2_000, 2, density) + np.random.default_rng(3).normal(0, 0.01, (2_000, 3)))):
        assert without_scatter(level) is level


def test_small_clouds_and_a_little_scatter_stay_as_they_are():
    rng = np.random.default_rng(4)
    for points in (rng.normal(size=(FEWEST - 1, 3)), np.concatenate([sheet(1_000, 5), rng.uniform(-1, 1, (15, 3))])):
        level = Level(points)
        assert without_scatter(level) is level
