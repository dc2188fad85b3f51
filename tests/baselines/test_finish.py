"""The finishes: ICP and generalised ICP from a pose that is some way off."""

import numpy as np
from scipy.spatial.transform import Rotation

from cmig_jax.baselines import finish_by_gicp, finish_by_icp, gicp, icp
from cmig_jax.metrics import isotropic_errors


def test_a_finish_lets_go_of_a_start_that_is_some_degrees_off_on_sparse_clouds(surface):
    """Independent samplings, a few points apart: where partners must be within 0.1, too many of a turned cloud have none."""
    start = Rotation.from_rotvec(np.radians([11.0, 0.0, 11.0])).as_matrix(), np.array([0.05, 0.0, 0.0])

    def angle(finish):
        poses = [finish(surface(100, 2 * i), surface(100, 2 * i + 1))[0] for i in range(10)]
        return isotropic_errors(np.stack(poses), np.zeros((10, 3)), np.tile(np.eye(3), (10, 1, 1)), np.zeros((10, 3)))[0].mean()

    assert angle(lambda x, y: finish_by_icp(x, y, start)) < 0.9 * angle(lambda x, y: icp(x, y, max_distance=0.1, start=start))


def test_a_finish_by_gicp_is_gicp_within_reach(pair):
    source, target, *_ = pair(5, 0.02)
    start = np.eye(3), np.zeros(3)
    for found, one in zip(finish_by_gicp(source, target, start), gicp(source, target, max_distance=0.1, start=start), strict=True):
        np.testing.assert_array_equal(found, one)
