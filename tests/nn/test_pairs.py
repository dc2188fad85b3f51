"""The first layer over pairs: against its formula, where points nearly coincide, and the digits of its statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.pairs import PairLayer
from cmig_jax.ops.moments import moments
from cmig_jax.ops.pairs import fast_moments, plain_values


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def first_layer(layer, kernel, *inputs):
    """Return the layer's value at every pair, `[B, N, M, features]`."""
    return plain_values(layer.apply({"params": {"kernel": kernel}}, *inputs))


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("C", [3, 4])
def test_a_pair_layer_is_the_matrix_on_length_direction_and_row_numbers(C, reverse):
    a, b, extra, kernel = normal(2, 5, C), normal(2, 6, C, seed=1) + 3, normal(2, 5, 2, seed=2), normal(3 + C, 8, seed=3)
    difference = b[:, None] - a[:, :, None]
    length = np.linalg.norm(difference, axis=-1, keepdims=True)
    direction = (-difference if reverse else difference) / (length + 1e-8)
    inputs = np.concatenate([length, direction, np.broadcast_to(extra[:, :, None], (2, 5, 6, 2))], -1)
    with jax.enable_x64(True):
        np.testing.assert_allclose(first_layer(PairLayer(8, reverse=reverse), kernel, a, b, extra), inputs @ kernel, atol=1e-12)


@pytest.mark.parametrize("C", [3, 32])
def test_coincident_points_have_finite_gradients_in_float32(C):
    a = normal(1, 6, C).astype(np.float32) + 1
    kernel = normal(1 + C, 2).astype(np.float32)
    gradient = jax.jit(jax.grad(lambda a: jnp.sum(first_layer(PairLayer(2), kernel, a, a) ** 2)))(a)
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("nearly", [0.0, 1e-6, 1e-4])
def test_nearly_equal_features_have_no_direction_larger_than_one(nearly):
    a, kernel = normal(1, 20, 64).astype(np.float32), normal(65, 4).astype(np.float32)
    b = np.concatenate([a * (1 + nearly * normal(1, 20, 64, seed=1)), normal(1, 9, 64, seed=2)], axis=1).astype(np.float32)
    pairs = np.asarray(first_layer(PairLayer(4), kernel, a, b))
    assert np.abs(np.diagonal(pairs, axis1=1, axis2=2)).max() < np.linalg.norm(kernel, axis=0).max()


@pytest.mark.parametrize("statistics", [fast_moments, lambda pairs: moments([plain_values(pairs)], "plain")], ids=["fast", "plain"])
@pytest.mark.parametrize("gap", [1e-2, 1e-5, 1e-7])
def test_statistics_keep_their_digits_where_the_pose_has_brought_points_onto_their_correspondents(gap, statistics):
    b, kernel = normal(2, 20, 3).astype(np.float32), normal(7, 8, seed=1).astype(np.float32)
    a = (b + gap * normal(2, 20, 3, seed=2)).astype(np.float32)
    found = statistics(PairLayer(8, reverse=True).apply({"params": {"kernel": kernel}}, a, b, a))
    difference = a.astype(np.float64)[:, :, None] - b[:, None]
    length = np.linalg.norm(difference, axis=-1, keepdims=True)
    inputs = np.concatenate([length, difference / (length + 1e-8), np.broadcast_to(a[:, :, None], difference.shape)], -1)
    pairs = inputs @ kernel.astype(np.float64)
    np.testing.assert_allclose(found.mean, pairs.mean(axis=(0, 1, 2)), atol=1e-5)
    np.testing.assert_allclose(found.variance, pairs.var(axis=(0, 1, 2)), rtol=1e-5)
