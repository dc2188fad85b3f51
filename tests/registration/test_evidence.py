"""What speaks for a pose: each number says what its name does."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.registration.evidence import evidence, turn_deg
from cmig_jax.registration.frame import matrix_of
from cmig_jax.registration.levels import Level

IDENTITY = np.eye(4)


def plate(count: int, seed: int) -> np.ndarray:
    """A square in the plane z = 0."""
    return np.random.default_rng(seed).uniform(-1, 1, (count, 3)) * [1, 1, 0]


@pytest.fixture(scope="module")
def clouds():
    return Level(plate(900, 0)), Level(plate(900, 1))


def shifted(*by: float) -> np.ndarray:
    return matrix_of(np.eye(3), np.array(by))


def test_two_samplings_of_a_plane_meet_in_it(clouds):
    found = evidence(*clouds, IDENTITY)
    # The spacing is the median distance of neighbours, so that a random point has none within twice that with a probability of 1 / 16.
    assert found["partners"] == pytest.approx(2 * 15 / 16, abs=0.03)
    assert found["plane_0"] == found["partners"]
    assert found["parallel_0"] == found["parallel_0.5"] == 0
    assert found["worse_cost"] == pytest.approx(found["cost"] / 2, abs=0.02)
    assert found["cost"] == pytest.approx(evidence(clouds[1], clouds[0], IDENTITY)["cost"])


def test_a_gap_between_planes_is_seen_in_distances_and_cost(clouds):
    spacing = clouds[0].spacing
    near, far = (evidence(*clouds, shifted(0, 0, gap * spacing)) for gap in (0.8, 4.0))
    assert near["plane_0.6"] == near["partners"] > 1.7
    assert evidence(*clouds, IDENTITY)["cost"] < near["cost"] < far["cost"] == 2
    assert far["partners"] == 0
    assert far["distance_3"] > 1.8


def test_normals_that_cross_are_seen_where_points_meet(clouds):
    upright = matrix_of(Rotation.from_euler("x", 90, degrees=True).as_matrix(), np.zeros(3))
    assert evidence(*clouds, upright)["parallel_0"] > 0.9 * evidence(*clouds, upright)["partners"] > 0.02


def test_points_beyond_a_cut_speak_less_against_a_pose_than_points_among_partners(clouds):
    source, target = clouds
    cut = evidence(source, Level(target.points[target.points[:, 0] < 0]), IDENTITY)
    rng = np.random.default_rng(2)
    holes = target.points[rng.random(len(target.points)) < 0.5]
    scattered = evidence(Level(np.concatenate([holes, holes[:100] + np.array([0, 0, 0.4])])), target, IDENTITY)
    assert cut["cost"] - cut["cut"] > 0.05
    assert scattered["cost"] - scattered["cut"] < 0.05
    assert cut["worse_partners"] == pytest.approx(1, abs=0.05)


def test_the_angle_of_a_pose():
    assert turn_deg(matrix_of(Rotation.from_euler("z", -70, degrees=True).as_matrix(), np.ones(3))) == pytest.approx(70)
