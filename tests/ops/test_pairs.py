"""Sums over pairs: values and derivatives of few and many rows, statistics that keep their digits, addition and normalisation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.ops.moments import Affine
from cmig_jax.ops.pairs import PairSum, PairTerm, fast_moments, fast_values, plain_values


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def pair_sum(offset=0.0, rows=8):
    """Draw sums over `rows` x 7 pairs, of a term with one column for all and a term with rows and columns."""
    length = PairTerm(normal(2, rows, 7, seed=1) + offset, None, normal(1, 1, 6, seed=2))
    direction = PairTerm(normal(2, rows, 7, seed=4) + offset, normal(2, rows, 6, seed=5), normal(2, 7, 6, seed=6))
    return PairSum(normal(2, rows, 6, seed=7) + offset, (length, direction))


@pytest.mark.parametrize("rows", [3, 40])  # few are added one by one, many by a product
def test_values_and_their_derivative_are_those_of_the_formula(rows):
    def formula(row, length, direction):
        direction = direction.scale[..., None] * (direction.row[:, :, None] + direction.column[:, None])
        return row[:, :, None] + length.scale[..., None] * length.column[:, None] + direction

    pairs, cotangent = pair_sum(rows=rows), normal(2, rows, 7, 6, seed=1)
    expected = jax.jit(jax.value_and_grad(lambda p: jnp.sum(cotangent * formula(p.row, *p.terms))))(pairs)
    for values in (fast_values, plain_values):
        found = jax.jit(jax.value_and_grad(lambda p, values=values: jnp.sum(cotangent * values(p))))(pairs)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), found, expected)


def test_statistics_keep_their_digits_in_float32_where_a_term_has_a_large_mean():
    pairs = pair_sum()
    pairs = PairSum(pairs.row, (PairTerm(1000 + pairs.terms[0].scale, None, pairs.terms[0].column),))
    single = jax.tree.map(lambda x: x.astype(np.float32), pairs)
    np.testing.assert_allclose(fast_moments(single).variance, fast_moments(pairs).variance, rtol=1e-3)


def test_sums_add_and_normalise_as_their_values_do():
    a, b = pair_sum(), pair_sum(1.0)
    np.testing.assert_allclose(plain_values(a + b), plain_values(a) + plain_values(b), atol=1e-12)
    mean, scale, bias = (jnp.asarray(normal(6, seed=seed)) for seed in range(3))
    expected = Affine(mean=mean, scale=scale, bias=bias)(plain_values(a))
    np.testing.assert_allclose(plain_values(a.scale_about(mean, scale, bias)), expected, atol=1e-12)
