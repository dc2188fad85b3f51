"""Nearest neighbours against brute force in float64; several devices; maxima over neighbours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.config import ComputeConfig
from cmig_jax.devices import device_mesh, sharing
from cmig_jax.ops import neighbours
from cmig_jax.ops.edges import neighbour_maximum
from cmig_jax.ops.neighbours import top_k

nearest = jax.jit(neighbours.nearest)


@jax.jit(static_argnums=1)
def knn(points, k):
    return neighbours.knn(points, k, ComputeConfig())


def clouds(C=3, offset=0.0, N=60, seed=0):
    return (np.random.default_rng(seed).uniform(-1, 1, (2, N, C)) + offset).astype(np.float32)


def brute(a, b):
    difference = a.astype(np.float64)[:, :, None] - b.astype(np.float64)[:, None]
    return np.sum(difference**2, axis=-1)


@pytest.mark.parametrize(("C", "offset"), [(3, 0.0), (3, 100.0), (3, -1000.0), (16, 0.0), (16, 30.0)])
def test_knn_equals_brute_force_at_any_distance_from_the_origin(C, offset):
    points = clouds(C, offset)
    expected = np.argsort(brute(points, points), axis=-1, kind="stable")[..., :9]
    np.testing.assert_array_equal(knn(points, 9), expected)
    np.testing.assert_array_equal(expected[..., 0], np.broadcast_to(np.arange(60), (2, 60)))


def test_all_points_are_neighbours_when_k_is_N():
    np.testing.assert_array_equal(np.sort(knn(clouds(N=7), 7), axis=-1), np.broadcast_to(np.arange(7), (2, 7, 7)))


@pytest.mark.parametrize("offset", [0.0, 500.0])
def test_nearest_equals_brute_force(offset):
    query, points = clouds(offset=offset, N=40, seed=1), clouds(offset=offset)
    index, distance = nearest(query, points)
    np.testing.assert_array_equal(index, np.argmin(brute(query, points), -1))
    np.testing.assert_allclose(distance, np.sqrt(np.min(brute(query, points), -1)), atol=1e-5)


def test_each_of_eight_devices_sorts_its_own_rows():
    mesh = device_mesh(8, 8)
    x = np.random.default_rng(0).normal(size=(8, 5, 11)).astype(np.float32)

    def shared(x):
        with sharing(mesh):
            return top_k(x, 4)

    compiled = jax.jit(shared, in_shardings=jax.NamedSharding(mesh, jax.P("batch"))).lower(x).compile()
    assert "all-gather" not in compiled.as_text()
    np.testing.assert_array_equal(compiled(x), np.argsort(-x, axis=-1)[..., :4])


def test_the_derivative_of_equal_neighbours_goes_to_the_nearest():
    index = np.array([[[2, 0, 1]] * 3])
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(neighbour_maximum(x, index, "fast"))))(jnp.ones((1, 3, 2)))
    np.testing.assert_array_equal(gradient[0], [[0, 0], [0, 0], [3, 3]])


@pytest.mark.parametrize("kernels", ["plain", "fast"])
def test_neighbour_maximum_keeps_the_type(kernels):
    x, index = jnp.ones((1, 3, 2), jnp.bfloat16), np.zeros((1, 3, 2), np.int32)
    assert jax.eval_shape(lambda x: neighbour_maximum(x, index, kernels), x).dtype == jnp.bfloat16


@pytest.mark.parametrize("rows", [0, 13])
@pytest.mark.parametrize("kernels", ["plain", "fast"])
@pytest.mark.parametrize("by", ["index", "nearest"])
@pytest.mark.parametrize(("k", "radius"), [(5, 0.5), (70, 0.8)])
def test_neighbours_within_a_radius_equal_brute_force(by, k, radius, kernels, rows):
    points = clouds()
    square = brute(points, points)
    expected = np.empty((2, 60, k), int)
    for b, i in np.ndindex(2, 60):
        inside = [j for j in range(60) if j != i and square[b, i, j] <= radius**2]
        ordered = sorted(inside, key=lambda j: j if by == "index" else square[b, i, j])[:k]
        expected[b, i] = ordered + [i] * (k - len(ordered))
    compute = ComputeConfig(kernels=kernels, rows=rows)
    found = jax.jit(lambda x: neighbours.within_radius(x, radius, k, by, compute))(points)
    np.testing.assert_array_equal(found, expected)
    assert np.any(expected[..., -1] == np.arange(60))  # a neighbourhood that is not full


def test_a_copy_of_a_point_is_its_neighbour_and_the_radius_counts():
    points = np.array([[0, 0, 0], [0, 0, 0], [1, 0, 0]], np.float32)
    found = neighbours.within_radius(points, 1.0, 2, "index", ComputeConfig())
    np.testing.assert_array_equal(found, [[1, 2], [0, 2], [0, 1]])
