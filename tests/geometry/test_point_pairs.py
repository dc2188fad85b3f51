"""Point-pair features: known angles, invariance, and a finite derivative for points that coincide."""

import jax
import jax.numpy as jnp
import numpy as np

from cmig_jax.geometry.point_pairs import angle_between, point_pair_features


def unit(*shape, seed):
    x = np.random.default_rng(seed).normal(size=(*shape, 3))
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def test_angles_are_exact_also_near_0_and_pi():
    with jax.enable_x64(True):
        angles = np.array([0.0, 1e-9, 0.3, np.pi / 2, 3.0, np.pi - 1e-9])
        other = np.stack([np.cos(angles), np.sin(angles), np.zeros(6)], axis=-1)
        found = angle_between(np.broadcast_to([2.0, 0, 0], (6, 3)), 5 * other)
        np.testing.assert_allclose(found, angles, atol=1e-15)


def test_a_rigid_motion_changes_nothing():
    with jax.enable_x64(True):
        offset, n, m = 0.2 * unit(20, seed=0), unit(20, seed=1), unit(20, seed=2)
        rotation, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
        moved = point_pair_features(*(x @ rotation.T for x in (offset, n, m)))
        np.testing.assert_allclose(moved, point_pair_features(offset, n, m), atol=1e-12)


def test_a_point_with_itself_has_features_0_and_derivative_0():
    normal = unit(1, seed=0)
    values, gradient = jax.jit(lambda d: (point_pair_features(d, normal, normal), jax.jacrev(point_pair_features)(d, normal, normal)))(
        jnp.zeros((1, 3))
    )
    np.testing.assert_allclose(values, np.zeros((1, 4)), atol=1e-6)
    np.testing.assert_array_equal(gradient, 0)
    along = jax.jacrev(point_pair_features, argnums=(0, 1, 2))(normal, normal, -normal)
    assert all(np.all(np.isfinite(x)) for x in along)
