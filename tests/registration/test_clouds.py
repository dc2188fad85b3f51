"""What is taken of a user's cloud: neither repeated points nor stray ones, and a centre and radius that these do not move."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax import register
from cmig_jax.registration.clouds import SORTED_UP_TO, user_cloud


def bumps(count, seed):
    """Sample a smooth body without symmetry."""
    u = np.random.default_rng(seed).normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    x, y, z = u.T[:, :, None]
    return u * (1 + 0.35 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.3 * z * x + 0.2 * y**3) * [1.3, 1, 0.8]


CLOUD = bumps(500, 0)
R = Rotation.from_rotvec([0.9, -1.3, 1.1]).as_matrix()


def is_right(found):
    return np.degrees(Rotation.from_matrix(found.matrix[:3, :3] @ R.T).magnitude()) < 3


@pytest.mark.parametrize("value", [1e5, 3.4e38, 1e300])
@pytest.mark.parametrize("count", [1, 150])
def test_points_too_far_away_for_a_sensor_are_left_out(value, count):
    """Some sensors give the largest number where nothing returned."""
    far = np.random.default_rng(1).choice([-value, value], (count, 3))
    found = user_cloud(np.r_[far, CLOUD], "source")
    clean = user_cloud(CLOUD, "source")
    np.testing.assert_array_equal(found.points, clean.points)
    np.testing.assert_array_equal(found.rows, clean.rows + count)
    assert found.radius == clean.radius


def test_stray_points_within_reach_move_the_centre_and_radius_little():
    clean = user_cloud(CLOUD, "source")
    found = user_cloud(np.r_[CLOUD, [[200.0, 0, 0], [0, -300, 0]]], "source")
    assert np.linalg.norm(found.centre - clean.centre) < 0.01 * clean.radius
    assert found.radius == pytest.approx(clean.radius, rel=0.02)


def test_many_missing_returns_at_the_origin_do_not_move_the_centre_of_a_large_cloud():
    cloud = bumps(SORTED_UP_TO, 0) + np.array([9, 0, 0])
    found, clean = user_cloud(np.r_[np.zeros((2 * SORTED_UP_TO, 3)), cloud], "source"), user_cloud(cloud, "source")
    assert np.linalg.norm(found.centre - clean.centre) < 1e-3
    assert len(found.points) == len(clean.points) + 1


def test_the_smallest_clouds_are_registered_in_silence(capfd):
    """small_gicp prints a line for every start of so small a cloud, and for points that leave its grid."""
    assert is_right(register(CLOUD[:10], CLOUD[:10] @ R.T))
    assert is_right(register(np.r_[CLOUD, [[1e7, 0, 0]]], bumps(400, 1) @ R.T))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("count", [150, 200, 290])
def test_smooth_bodies_of_few_points(count):
    assert is_right(register(bumps(count, 2), bumps(count, 3) @ R.T))
