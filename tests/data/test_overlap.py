"""The overlap of two clouds: the smaller of both shares, under the true pose."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.data.overlap import MOST_POINTS, overlap

GRID = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)
R, t = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), np.array([4.0, -2.0, 0.5])


@pytest.mark.parametrize(("kept", "share"), [(64, 1.0), (32, 0.5), (1, 1 / 64)])
def test_it_is_the_smaller_share_whichever_cloud_is_the_source(kept, share):
    assert overlap(GRID, GRID[:kept] @ R.T + t, R, t, 0.1) == share
    assert overlap(GRID[:kept], GRID @ R.T + t, R, t, 0.1) == share


def test_it_is_measured_under_the_true_pose():
    assert overlap(GRID, GRID @ R.T + t, np.eye(3), np.zeros(3), 0.1) < 0.1
    assert overlap(GRID, GRID + 5, np.eye(3), np.zeros(3), 0.1) == 0


@pytest.mark.parametrize(("shift", "share"), [(0.09, 1.0), (0.11, 0.0)])
def test_points_correspond_if_they_are_closer_than_the_distance(shift, share):
    assert overlap(GRID, GRID + np.array([shift, 0, 0]), np.eye(3), np.zeros(3), 0.1) == share


@pytest.mark.parametrize("unit", [1.0, 50.0])
def test_large_clouds_are_thinned_and_any_unit_will_do(unit):
    line = unit * np.linspace(0, 1, 4 * MOST_POINTS + 1)[:, None] * [1.0, 0, 0]
    assert overlap(line[: 2 * MOST_POINTS], line, np.eye(3), np.zeros(3), 0.01 * unit) == pytest.approx(0.51, abs=0.01)
