"""Neighbours against brute force in float64; the maximum over them against the plain gather."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.geometry import neighbors
from cmig_jax.geometry.neighbors import map_rows, neighbour_maximum, squared_distances

knn = jax.jit(neighbors.knn, static_argnums=(1, 2))
nearest = jax.jit(neighbors.nearest, static_argnums=2)


def clouds(C=3, offset=0.0, N=60, seed=0):
    return (np.random.default_rng(seed).uniform(-1, 1, (2, N, C)) + offset).astype(np.float32)


def brute(a, b):
    difference = a.astype(np.float64)[:, :, None] - b.astype(np.float64)[:, None]
    return np.sum(difference**2, axis=-1)


@pytest.mark.parametrize(("C", "offset"), [(3, 0.0), (3, 100.0), (3, -1000.0), (16, 0.0), (16, 30.0)])
def test_knn_equals_brute_force_wherever_the_cloud_lies(C, offset):
    points = clouds(C, offset)
    expected = np.argsort(brute(points, points), axis=-1, kind="stable")[..., :9]
    np.testing.assert_array_equal(knn(points, 9), expected)


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_each_point_is_its_own_first_neighbour(offset):
    neighbours = knn(clouds(offset=offset), 5)
    np.testing.assert_array_equal(neighbours[..., 0], np.broadcast_to(np.arange(60), (2, 60)))


def test_all_points_are_neighbours_when_k_is_N():
    np.testing.assert_array_equal(np.sort(knn(clouds(N=7), 7), axis=-1), np.broadcast_to(np.arange(7), (2, 7, 7)))


@pytest.mark.parametrize("rows", [1, 7, 60, 100])
def test_chunks_of_rows_equal_the_whole(rows):
    points, others = clouds(), clouds(seed=1)
    np.testing.assert_array_equal(knn(points, 9, rows), knn(points, 9))
    (index, distance), (whole_index, whole_distance) = (nearest(points, others, r) for r in (rows, 0))
    np.testing.assert_array_equal(index, whole_index)
    np.testing.assert_allclose(distance, whole_distance, atol=1e-5)


@pytest.mark.parametrize("offset", [0.0, 500.0])
def test_nearest_equals_brute_force(offset):
    query, points = clouds(offset=offset, N=40, seed=1), clouds(offset=offset)
    index, distance = nearest(query, points)
    np.testing.assert_array_equal(index, np.argmin(brute(query, points), -1))
    np.testing.assert_allclose(distance, np.sqrt(np.min(brute(query, points), -1)), atol=1e-5)


def test_squared_distances_are_never_negative_and_keep_float64():
    points = clouds(offset=1000.0)
    assert np.all(squared_distances(points, points) >= 0)
    with jax.enable_x64(True):
        exact = squared_distances(points.astype(np.float64), points.astype(np.float64))
        assert exact.dtype == jnp.float64
        np.testing.assert_allclose(exact, brute(points, points), atol=1e-12)


def gather_maximum(x, neighbours):
    return jnp.max(jax.vmap(lambda cloud, index: cloud[index])(x, neighbours), axis=2)


def test_neighbour_maximum_and_its_gradient_equal_the_gathers():
    x, cotangent = clouds(5), clouds(5, seed=1)
    neighbours = knn(clouds(seed=2), 6)

    @functools.partial(jax.jit, static_argnums=0)
    def value_and_gradient(function, x):
        value, pull = jax.vjp(lambda x: function(x, neighbours), x)
        return value, pull(cotangent)[0]

    (value, gradient), (expected, expected_gradient) = (value_and_gradient(f, x) for f in (neighbour_maximum, gather_maximum))
    np.testing.assert_array_equal(value, expected)
    np.testing.assert_allclose(gradient, expected_gradient, atol=1e-6)


def test_gradient_of_equal_neighbours_goes_to_the_nearest():
    neighbours = np.array([[[2, 0, 1]] * 3])
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(neighbour_maximum(x, neighbours))))(jnp.ones((1, 3, 2)))
    np.testing.assert_array_equal(gradient[0], [[0, 0], [0, 0], [3, 3]])


def test_neighbour_maximum_keeps_the_dtype():
    x, neighbours = jnp.ones((1, 3, 2), jnp.bfloat16), np.zeros((1, 3, 2), np.int32)
    assert jax.eval_shape(neighbour_maximum, x, neighbours).dtype == jnp.bfloat16


@pytest.mark.parametrize("rows", [0, 1, 4, 10, 99])
def test_map_rows_joins_trees_of_any_rank_in_order(rows):
    x = np.arange(60, dtype=np.float32).reshape(2, 3, 10, 1)
    result = map_rows(lambda c: {"rank 3": c[..., 0] ** 2, "rank 5": jnp.stack([c, -c], -1)}, x, rows)
    np.testing.assert_array_equal(result["rank 3"], x[..., 0] ** 2)
    np.testing.assert_array_equal(result["rank 5"], np.stack([x, -x], -1))


def test_map_rows_is_differentiable():
    x = clouds()
    gradient = jax.grad(lambda x: jnp.sum(map_rows(jnp.sin, x, 7)))(x)
    np.testing.assert_allclose(gradient, np.cos(x), atol=1e-6)
