"""Rotations from and to quaternions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.geometry.rotations import quaternion_from_rotation, quaternion_product, rotation_from_quaternion, unit_quaternion


@pytest.mark.parametrize("length", [1.0, -1.0, 3.7])
def test_quaternions_of_any_length_give_their_rotation(length):
    rotation = Rotation.random(20, rng=np.random.default_rng(0))
    with jax.enable_x64(True):
        quaternion = jnp.asarray(length * rotation.as_quat(scalar_first=True)).reshape(4, 5, 4)
        np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation.as_matrix().reshape(4, 5, 3, 3), atol=1e-14)


def quaternions(count=20):
    """Draw unit quaternions with w >= 0, some of them turns by half and by nothing."""
    random = Rotation.random(count, rng=np.random.default_rng(1)).as_quat(canonical=True, scalar_first=True)
    return np.concatenate([np.eye(4), np.full((1, 4), 0.5), [[0.0, 0.6, -0.8, 0.0]], random])


def test_rotation_and_quaternion_invert_each_other():
    with jax.enable_x64(True):
        R = rotation_from_quaternion(jnp.asarray(quaternions()))
        found = quaternion_from_rotation(R)
        np.testing.assert_allclose(rotation_from_quaternion(found), R, atol=1e-14)
        np.testing.assert_allclose(found[6:], quaternions()[6:], atol=1e-14)
        assert np.asarray(found)[:, 0].min() >= 0


def test_a_product_turns_by_the_second_and_then_by_the_first():
    with jax.enable_x64(True):
        a, b = jnp.asarray(quaternions()), jnp.asarray(quaternions()[::-1])
        expected = rotation_from_quaternion(a) @ rotation_from_quaternion(b)
        np.testing.assert_allclose(rotation_from_quaternion(quaternion_product(a, b)), expected, atol=1e-14)
        c = jnp.asarray(np.roll(quaternions(), 3, axis=0))
        associated = quaternion_product(quaternion_product(a, b), c), quaternion_product(a, quaternion_product(b, c))
        np.testing.assert_allclose(*associated, atol=1e-14)


@pytest.mark.parametrize("length", [0.0, 1e-20, 1e-3, 5.0])
def test_unit_quaternions_and_their_derivatives_are_finite(length):
    x = length * jnp.asarray(quaternions(3), jnp.float32)
    unit = unit_quaternion(x)
    assert np.all(np.isfinite(jax.grad(lambda x: jnp.sum(unit_quaternion(x)))(x)))
    np.testing.assert_allclose(jnp.linalg.norm(unit, axis=-1), 1 if length > 1e-6 else 1e12 * length, rtol=1e-5)
