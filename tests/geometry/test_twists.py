"""Twists: the exponential map is a homomorphism along an axis, agrees with the matrix exponential, and is smooth at 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from cmig_jax.geometry.twists import SERIES_BELOW, exp, exp_by_generators, hat


def twists(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=(*shape, 6))


def generator(xi):
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[:3, 3] = hat(jnp.asarray(xi[:3])), xi[3:]
    return matrix


def test_hat_is_the_cross_product():
    with jax.enable_x64(True):
        w, x = twists(4)[:, :3], twists(4, seed=1)[:, :3]
        np.testing.assert_allclose(np.einsum("nij,nj->ni", hat(w), x), np.cross(w, x), atol=1e-14)


@pytest.mark.parametrize("size", [0, 1e-9, 1e-3, 0.999 * SERIES_BELOW, 1.001 * SERIES_BELOW, 1, 3.1, 7])
def test_the_motion_is_the_matrix_exponential_at_every_angle(size):
    with jax.enable_x64(True):
        xi = twists(3)
        xi[:, :3] *= size / np.linalg.norm(xi[:, :3], axis=-1, keepdims=True)
        expected = np.stack([scipy.linalg.expm(generator(x)) for x in xi])
        np.testing.assert_allclose(exp(xi).as_matrix(), expected, atol=1e-13)
        derivative = jax.jacfwd(lambda x: exp(x).as_matrix())(xi[0])
        for k in range(6):
            _, slope = scipy.linalg.expm_frechet(generator(xi[0]), generator(np.eye(6)[k]))
            np.testing.assert_allclose(derivative[..., k], slope, atol=1e-11)


def test_motions_along_one_twist_add_up_and_the_opposite_twist_undoes_one():
    with jax.enable_x64(True):
        xi = twists(5, 2)
        np.testing.assert_allclose(exp(0.3 * xi).compose(exp(0.7 * xi)).as_matrix(), exp(xi).as_matrix(), atol=1e-14)
        np.testing.assert_allclose(exp(-xi).as_matrix(), exp(xi).inverse().as_matrix(), atol=1e-14)


def test_the_derivative_by_generators_is_a_twist_from_the_left_and_exact_at_0():
    with jax.enable_x64(True):
        xi = twists()
        derivative = jax.jit(jax.jacrev(lambda x: exp_by_generators(x).as_matrix()))(xi)
        np.testing.assert_allclose(exp_by_generators(xi).as_matrix(), exp(xi).as_matrix(), atol=0)
        from_left = jax.jacfwd(lambda x: exp(x).compose(exp(jnp.asarray(xi))).as_matrix())(np.zeros(6))
        np.testing.assert_allclose(derivative, from_left, atol=1e-14)
        at_zero = [jax.jacrev(lambda x, f=f: f(x).as_matrix())(np.zeros(6)) for f in (exp, exp_by_generators)]
        np.testing.assert_allclose(*at_zero, atol=1e-15)


def test_float32_stays_float32_and_accurate():
    xi = twists(3).astype(np.float32)
    motion = exp(xi)
    assert motion.R.dtype == motion.t.dtype == jnp.float32
    np.testing.assert_allclose(motion.as_matrix(), [scipy.linalg.expm(generator(x)) for x in xi], atol=2e-6)
