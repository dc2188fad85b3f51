"""Clouds whose pose is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.transform import RigidTransform


def surface(points: int, seed: int) -> np.ndarray:
    """A bent sheet: no symmetry."""
    u, v = np.random.default_rng(seed).uniform(-1, 1, (2, points))
    return np.stack([0.8 * u, 0.5 * v, 0.3 * u**2 - 0.2 * v**3 + 0.2 * np.sin(2 * u * v)], 1)


@pytest.fixture(name="surface")
def surface_fixture():
    return surface


@pytest.fixture
def pair():
    """Make a source, a target of seven eighths of its points in another order, and the true pose."""

    def make(angle_deg: float, shift: float, points: int = 800, noise: float = 0.0):
        R, t = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.6, 0.0, 0.8])).as_matrix(), shift * np.array([1.0, 0.0, 0.0])
        rng = np.random.default_rng(1)
        source = surface(points, 0)
        target = (source @ R.T + t)[rng.permutation(points)][: points * 7 // 8]
        return source + rng.normal(0, noise, source.shape), target + rng.normal(0, noise, target.shape), RigidTransform(R=R, t=t)

    return make


@pytest.fixture
def errors():
    """Return the angle in degrees and the distance between two poses."""

    def compare(found: RigidTransform, true: RigidTransform) -> tuple[float, float]:
        return float(np.degrees(true.inverse().compose(found).angle())), float(np.linalg.norm(found.t - true.t))

    return compare


@pytest.fixture
def equal():
    """Assert that two poses are the same numbers."""

    def check(one: RigidTransform, other: RigidTransform) -> None:
        np.testing.assert_array_equal(one.R, other.R)
        np.testing.assert_array_equal(one.t, other.t)

    return check
