"""Rotations from quaternions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.geometry.rotations import rotation_from_quaternion


@pytest.mark.parametrize("length", [1.0, -1.0, 3.7])
def test_quaternions_of_any_length_give_their_rotation(length):
    rotation = Rotation.random(20, rng=np.random.default_rng(0))
    with jax.enable_x64(True):
        quaternion = jnp.asarray(length * rotation.as_quat(scalar_first=True)).reshape(4, 5, 4)
        np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation.as_matrix().reshape(4, 5, 3, 3), atol=1e-14)
