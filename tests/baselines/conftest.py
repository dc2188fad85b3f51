"""Clouds whose pose is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def surface(points: int, seed: int) -> np.ndarray:
    """A bent sheet: no symmetry."""
    u, v = np.random.default_rng(seed).uniform(-1, 1, (2, points))
    return np.stack([0.8 * u, 0.5 * v, 0.3 * u**2 - 0.2 * v**3 + 0.2 * np.sin(2 * u * v)], 1)


@pytest.fixture(name="surface")
def surface_fixture():
    return surface


@pytest.fixture
def pair():
    """Make a source and a target that holds seven eighths of its points in another order, with the pose between them."""

    def make(angle_deg: float, shift: float, points: int = 800, noise: float = 0.0):
        R, t = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.6, 0.0, 0.8])).as_matrix(), shift * np.array([1.0, 0.0, 0.0])
        rng = np.random.default_rng(1)
        source = surface(points, 0)
        target = (source @ R.T + t)[rng.permutation(points)][: points * 7 // 8]
        return source + rng.normal(0, noise, source.shape), target + rng.normal(0, noise, target.shape), R, t

    return make
