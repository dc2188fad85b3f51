"""Refinement: ICP and generalised ICP from a pose that is some way off."""

import numpy as np
from scipy.spatial.transform import Rotation

from cmig_jax.baselines import CUTOFFS, gicp, icp, refine_by_gicp, refine_by_icp
from cmig_jax.baselines.method import no_motion
from cmig_jax.transform import RigidTransform


def test_refinement_leaves_a_start_that_is_some_degrees_off_on_sparse_clouds(surface, errors):
    """Clouds are sampled independently, so within a distance of 0.1 too many points of a rotated cloud have no counterpart."""
    start = RigidTransform(R=Rotation.from_rotvec(np.radians([11.0, 0.0, 11.0])).as_matrix(), t=np.array([0.05, 0.0, 0.0]))

    def angle(refine):
        return np.mean([errors(refine(surface(100, 2 * i), surface(100, 2 * i + 1)), no_motion())[0] for i in range(10)])

    assert angle(lambda x, y: refine_by_icp(x, y, start)) < 0.9 * angle(lambda x, y: icp(x, y, max_distance=0.1, start=start))


def test_refinement_is_icp_and_gicp_with_their_cutoffs(pair, equal):
    source, target, true = pair(5, 0.02)
    rounds = no_motion()
    for cutoff in CUTOFFS["ICP"]:
        rounds = icp(source, target, max_distance=cutoff, start=rounds)
    equal(refine_by_icp(source, target, no_motion()), rounds)
    equal(refine_by_gicp(source, target, true), gicp(source, target, max_distance=CUTOFFS["GICP"][0], start=true))
