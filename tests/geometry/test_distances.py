"""Distances: never negative, exact in float64, with derivative 0 where points coincide."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.geometry.distances import pair_distances, squared_distances


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def test_squared_distances_are_never_negative_and_stay_in_float64():
    points = (normal(2, 60, 3) + 1000).astype(np.float32)
    assert np.all(squared_distances(points, points) >= 0)
    with jax.enable_x64(True):
        wide = points.astype(np.float64)
        exact = squared_distances(wide, wide)
        assert exact.dtype == jnp.float64
        np.testing.assert_allclose(exact, np.sum((wide[:, :, None] - wide[:, None]) ** 2, -1), atol=1e-11)


@pytest.mark.parametrize("C", [3, 8])
def test_pair_distances_are_zero_with_derivative_zero_where_points_coincide(C):
    with jax.enable_x64(True):
        a, b = normal(1, 4, C), normal(1, 5, C, seed=1)
        b[0, 1] = a[0, 2]
        gradient = jax.jit(jax.grad(lambda a: jnp.sum(pair_distances(a, b)[0, 2])))(a)
        expected = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1)
        np.testing.assert_allclose(jax.jit(pair_distances)(a, b), expected, atol=1e-12)
        others = [j for j in range(5) if j != 1]
        slope = np.sum((a[0, 2] - b[0, others]) / expected[0, 2, others, None], axis=0)
        np.testing.assert_allclose(gradient[0, 2], slope, atol=1e-12)


@pytest.mark.parametrize("C", [3, 32])
def test_points_are_at_distance_zero_from_themselves_in_float32(C):
    a = normal(1, 6, C).astype(np.float32) + 1
    np.testing.assert_array_equal(np.diagonal(pair_distances(a, a)[0]), 0)
