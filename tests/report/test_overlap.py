"""The overlap of a pair, and pairs that are measured on the way."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.report.overlap import Measured, overlap

GRID = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3)
R, t = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), np.array([4.0, -2.0, 0.5])


@pytest.mark.parametrize(("kept", "share"), [(64, 1.0), (32, 0.5), (1, 1 / 64)])
def test_the_share_of_source_points_that_the_target_has(kept, share):
    assert overlap(GRID, GRID[:kept] @ R.T + t, R, t, 0.1) == share


def test_it_is_of_the_source_and_under_the_true_pose():
    assert overlap(GRID[:16], GRID @ R.T + t, R, t, 0.1) == 1
    assert overlap(GRID, GRID @ R.T + t, np.eye(3), np.zeros(3), 0.1) < 0.1


@pytest.mark.parametrize(("noise", "share"), [(0.09, 1.0), (0.11, 0.0)])
def test_nearer_than_the_distance(noise, share):
    assert overlap(GRID, GRID + np.array([noise, 0, 0]), np.eye(3), np.zeros(3), 0.1) == share


def test_pairs_are_measured_in_order_and_unchanged():
    pairs = [{"source": GRID, "target": GRID[:kept], "R": np.eye(3), "t": np.zeros(3)} for kept in (64, 16, 32)]
    measured = Measured(pairs, 0.1)
    for _ in range(2):
        assert all(given is pair for given, pair in zip(measured, pairs, strict=True))
        assert measured.overlaps == [1.0, 0.25, 0.5]
    assert len(measured) == 3
