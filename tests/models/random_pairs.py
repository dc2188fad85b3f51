"""Random pairs for the tests of networks."""

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform


def pairs(N=17, M=23, dtype=np.float64):
    """Return two pairs of random clouds and poses."""
    rng = np.random.default_rng(0)
    truth = RigidTransform(R=Rotation.random(2, rng=rng).as_matrix().astype(dtype), t=rng.normal(size=(2, 3)).astype(dtype))
    return Batch(rng.normal(size=(2, N, 3)).astype(dtype), rng.normal(size=(2, M, 3)).astype(dtype), target_from_source=truth)


def assert_same(a, b, atol=1e-10):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)
