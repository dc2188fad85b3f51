"""Sinkhorn's normalisation with slack: sums, limits, symmetries, and the plain algorithm on the padded matrix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.geometry import sinkhorn

log_sinkhorn = jax.jit(sinkhorn.log_sinkhorn, static_argnums=1)


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


def affinity(*shape, seed=0, scale=3.0):
    return scale * np.random.default_rng(seed).normal(size=shape)


@pytest.mark.parametrize("rounds", [0, 1, 5])
def test_equals_normalising_the_padded_matrix_in_turn(rounds):
    logarithms = affinity(2, 6, 9)
    padded = np.pad(np.exp(logarithms), ((0, 0), (0, 1), (0, 1)), constant_values=1)
    for _ in range(rounds):
        padded[:, :-1] /= padded[:, :-1].sum(axis=2, keepdims=True)
        padded[:, :, :-1] /= padded[:, :, :-1].sum(axis=1, keepdims=True)
    np.testing.assert_allclose(np.exp(log_sinkhorn(logarithms, rounds)), padded[:, :-1, :-1], rtol=1e-12)
    matching, slack = sinkhorn.log_sinkhorn_with_slack(logarithms, rounds)
    np.testing.assert_allclose(np.exp(matching), padded[:, :-1, :-1], rtol=1e-12)
    np.testing.assert_allclose(np.exp(slack), padded[:, :-1, -1], rtol=1e-12)


def test_no_column_sums_to_more_than_1_and_in_the_end_no_row_does():
    match = [np.exp(log_sinkhorn(affinity(3, 7, 5), rounds)) for rounds in (1, 5, 200)]
    assert all(np.all(x.sum(axis=-2) < 1) for x in match)
    assert np.max(match[2].sum(axis=-1)) < 1 + 1e-3


def test_at_the_fixed_point_the_transposed_problem_has_the_transposed_answer():
    logarithms = affinity(2, 4, 6)
    ours, other = log_sinkhorn(logarithms, 2000), log_sinkhorn(logarithms.swapaxes(1, 2), 2000)
    np.testing.assert_allclose(np.exp(ours), np.exp(other).swapaxes(1, 2), atol=1e-6)


def test_order_of_rows_and_columns_does_not_matter():
    logarithms, rng = affinity(5, 8), np.random.default_rng(1)
    rows, columns = rng.permutation(5), rng.permutation(8)
    np.testing.assert_allclose(log_sinkhorn(logarithms[rows][:, columns], 5), log_sinkhorn(logarithms, 5)[rows][:, columns], atol=1e-12)


@pytest.mark.parametrize("rounds", [1, 5, 50])
def test_points_that_nothing_attracts_stay_without_partner_and_a_strong_match_comes_to_1(rounds):
    logarithms = np.full((3, 4), -30.0)
    logarithms[0, 2] = 30
    expected = np.zeros((3, 4))
    expected[0, 2] = rounds / (rounds + 1)  # each round takes what the slack of row and column leave
    np.testing.assert_allclose(np.exp(log_sinkhorn(logarithms, rounds)), expected, atol=1e-5)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_the_derivative_is_finite(scale):
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(jnp.exp(sinkhorn.log_sinkhorn(x, 5)) ** 2)))(affinity(2, 5, 6, scale=scale))
    assert np.all(np.isfinite(gradient))
