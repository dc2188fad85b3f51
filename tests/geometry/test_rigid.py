"""Rigid transforms are a group that acts on points; angles keep their digits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.geometry.rigid import rotation_angle, rotation_from_quaternion
from cmig_jax.structs import RigidTransform


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def transforms(seed, count=5):
    rng = np.random.default_rng(seed)
    return RigidTransform(R=jnp.asarray(Rotation.random(count, rng=rng).as_matrix()), t=jnp.asarray(rng.normal(size=(count, 3))))


def assert_same(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-14), a, b)


def test_composition_is_associative():
    a, b, c = (transforms(seed) for seed in range(3))
    assert_same(a.compose(b).compose(c), a.compose(b.compose(c)))


def test_identity_is_neutral_on_both_sides():
    a, one = transforms(0), RigidTransform.identity((5,), jnp.float64)
    assert_same(a.compose(one), a)
    assert_same(one.compose(a), a)


def test_inverse_undoes_on_both_sides():
    a, one = transforms(0), RigidTransform.identity((5,), jnp.float64)
    assert_same(a.inverse().compose(a), one)
    assert_same(a.compose(a.inverse()), one)


def test_applying_a_composition_applies_the_first_then_the_second():
    a, b, points = transforms(0), transforms(1), jnp.asarray(np.random.default_rng(2).normal(size=(5, 7, 3)))
    assert_same(a.compose(b).apply(points), a.apply(b.apply(points)))


def test_apply_is_R_x_plus_t():
    a, points = transforms(0, 1), np.random.default_rng(1).normal(size=(1, 7, 3))
    np.testing.assert_allclose(a.apply(jnp.asarray(points))[0], points[0] @ np.asarray(a.R[0]).T + np.asarray(a.t[0]), atol=1e-14)


def test_numpy_stays_numpy_with_all_its_digits():
    with jax.enable_x64(False):
        R, offset = Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([5e6, 1e7, 0.123])
        a = RigidTransform(R=R, t=offset)
        points = np.random.default_rng(0).normal(size=(7, 3)) + offset
        np.testing.assert_allclose(a.apply(points), points @ R.T + offset, rtol=1e-15)
        np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, rtol=1e-14)
        np.testing.assert_allclose(a.inverse().compose(a).t, 0, atol=1e-8)
        assert {type(x) for b in (a.inverse(), a.compose(a)) for x in (b.R, b.t)} == {np.ndarray}


def test_identity_keeps_the_dtype_asked_for():
    assert {leaf.dtype for leaf in jax.tree.leaves(RigidTransform.identity((2,)))} == {jnp.dtype("float32")}
    assert {leaf.dtype for leaf in jax.tree.leaves(transforms(0).compose(transforms(1)).inverse())} == {jnp.dtype("float64")}


def test_quaternions_of_any_length_give_their_rotation():
    rotation = Rotation.random(20, rng=np.random.default_rng(0))
    quaternion = jnp.asarray(rotation.as_quat(scalar_first=True))
    for length in (1.0, -1.0, 3.7):
        np.testing.assert_allclose(rotation_from_quaternion(length * quaternion), rotation.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 2.0, 3.0])
def test_angle_of_a_known_rotation(angle):
    axis = np.array([0.6, -0.48, 0.64])
    turn, frame = Rotation.from_rotvec(angle * axis), Rotation.random(rng=np.random.default_rng(1))
    measured = rotation_angle(jnp.asarray((frame * turn).as_matrix()), jnp.asarray(frame.as_matrix()))
    np.testing.assert_allclose(measured, angle, rtol=1e-6, atol=1e-15)


def test_half_turns_measure_pi():
    for turn in (jnp.diag(jnp.array([1.0, -1, -1])), jnp.diag(jnp.array([-1.0, -1, 1]))):
        np.testing.assert_allclose(rotation_angle(turn, jnp.eye(3)), np.pi, atol=1e-7)


def test_angle_is_symmetric_and_bounded():
    a, b = transforms(0, 50).R, transforms(1, 50).R
    measured = rotation_angle(a, b)
    np.testing.assert_array_equal(measured, rotation_angle(b, a))
    assert bool(jnp.all((measured >= 0) & (measured <= jnp.pi)))


def test_small_angles_keep_their_digits_in_float32():
    turn = Rotation.from_rotvec([0, 0, 1e-4]).as_matrix().astype(np.float32)
    measured = rotation_angle(jnp.asarray(turn), jnp.eye(3, dtype=jnp.float32))
    assert measured.dtype == jnp.float32
    np.testing.assert_allclose(measured, 1e-4, rtol=1e-5)
