"""Networks over pairs in chunks equal the plain layers on all pairs at once: values, gradients and batch statistics."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.mlp import Dense, NormedMLP
from cmig_jax.nn.norm import BatchNorm, moments
from cmig_jax.nn.pairs import PairSum, PairTerm
from cmig_jax.nn.tower import Tower, chunks_of, joined, sweep

WIDTHS = (6, 5, 4)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def pair_sum(offset=0.0, dtype=np.float64):
    """Draw sums over 8 x 7 pairs whose terms have large means."""
    length = PairTerm(normal(2, 8, 7, seed=1) + offset, None, normal(1, 1, 6, seed=2))
    direction = PairTerm(normal(2, 8, 7, seed=4) + offset, normal(2, 8, 6, seed=5), normal(2, 7, 6, seed=6))
    whole = PairSum(normal(2, 8, 6, seed=7) + offset, (length, direction))
    return jax.tree.map(lambda x: x.astype(dtype), whole)


@pytest.mark.parametrize("rows", [3, 40])  # few are added one by one, many by a product
def test_the_derivative_of_the_values_is_that_of_their_formula(rows):
    def formula(row, length, direction):
        direction = direction.scale[..., None] * (direction.row[:, :, None] + direction.column[:, None])
        return row[:, :, None] + length.scale[..., None] * length.column[:, None] + direction

    row, cotangent = normal(2, rows, 6), normal(2, rows, 7, 6, seed=1)
    length = PairTerm(normal(2, rows, 7, seed=2), None, normal(1, 1, 6, seed=3))
    direction = PairTerm(normal(2, rows, 7, seed=4), normal(2, rows, 6, seed=5), normal(2, 7, 6, seed=6))
    ours = jax.jit(jax.grad(lambda p: jnp.sum(cotangent * p.values())))(PairSum(row, (length, direction)))
    plain = jax.jit(jax.grad(lambda p: jnp.sum(cotangent * formula(p.row, *p.terms))))(PairSum(row, (length, direction)))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), ours, plain)


class Plain(nn.Module):
    """The tower on a tensor of all pairs."""

    @nn.compact
    def __call__(self, pairs, *, train):
        hidden = nn.relu(BatchNorm(WIDTHS[0], name="first_norm")(pairs.values(), train=train))
        hidden = NormedMLP(WIDTHS[1:], name="hidden")(hidden, train=train)
        return Dense(1, name="last")(hidden)[..., 0], jnp.max(hidden, axis=-2)


@functools.partial(jax.jit, static_argnums=(0, 3))
def value_and_gradients(layer, variables, pairs, train):
    def total(params, pairs):
        outputs, state = layer.apply({**variables, "params": params}, pairs, train=train, mutable=["batch_stats"])
        return sum(jnp.sum(jnp.sin(x + jnp.arange(x.size).reshape(x.shape))) for x in outputs), (outputs, state)

    return jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(variables["params"], pairs)


@pytest.mark.parametrize("train", [False, True])
@pytest.mark.parametrize("rows", [0, 1, 3, 4])
def test_a_tower_in_chunks_is_the_plain_tower(rows, train, random_like):
    pairs = pair_sum()
    shapes = jax.eval_shape(functools.partial(Plain().init, train=False), jax.random.key(0), pairs)
    variables = random_like(shapes, dtype=np.float64)
    ours = value_and_gradients(Tower(WIDTHS, rows=rows, pooled=True), variables, pairs, train)
    plain = value_and_gradients(Plain(), variables, pairs, train)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-10), ours, plain)


def test_a_tower_has_the_parameters_of_the_plain_tower():
    trees = [jax.eval_shape(functools.partial(layer.init, train=True), jax.random.key(0), pair_sum()) for layer in (Plain(), Tower(WIDTHS))]
    assert jax.tree.structure(trees[0]) == jax.tree.structure(trees[1])
    assert jax.tree.leaves(trees[0]) == jax.tree.leaves(trees[1])


def test_statistics_of_a_sum_are_those_of_its_values():
    ours, plain = pair_sum(3.0).moments(), moments([pair_sum(3.0).values()])
    np.testing.assert_allclose(ours.mean, plain.mean, atol=1e-12)
    np.testing.assert_allclose(ours.variance, plain.variance, atol=1e-12)
    assert ours.count == plain.count == 2 * 8 * 7


def test_statistics_keep_their_digits_in_float32_where_a_term_has_a_large_mean():
    pairs = pair_sum()
    pairs = PairSum(pairs.row, (PairTerm(1000 + pairs.terms[0].scale, None, pairs.terms[0].column),))
    single = jax.tree.map(lambda x: x.astype(np.float32), pairs)
    np.testing.assert_allclose(single.moments().variance, pairs.moments().variance, rtol=1e-3)


def test_sums_add_and_normalise_as_their_values_do():
    a, b = pair_sum(), pair_sum(1.0)
    np.testing.assert_allclose((a + b).values(), a.values() + b.values(), atol=1e-12)
    affine = (
        BatchNorm(6)
        .bind(
            {
                "params": {"scale": normal(6), "bias": normal(6, seed=1)},
                "batch_stats": {"mean": normal(6, seed=2), "var": normal(6, seed=3) ** 2},
            }
        )
        .affine(None)
    )
    np.testing.assert_allclose(a.normalised(affine).values(), affine(a.values()), atol=1e-12)


@pytest.mark.parametrize("rows", [0, 1, 5, 8, 100])
def test_chunks_join_to_the_whole(rows):
    x = normal(2, 8, 7, 3)
    chunks = chunks_of(2, 8, 7, 3, rows)(x)
    assert chunks.shape[2] <= (rows or 8)
    np.testing.assert_array_equal(joined(chunks), x)


def test_a_sweep_has_the_gradients_of_the_function():
    def function(shared, chunk):
        return jnp.sin(chunk @ shared), jnp.sum(chunk)

    def total(run):
        def run_and_sum(shared, chunks):
            y, s = run(shared, chunks)
            return jnp.sum(y**2) + jnp.sum(s**3)

        return run_and_sum

    arguments = normal(4, 3), normal(5, 2, 4, seed=1)
    ours = jax.jit(jax.grad(total(lambda *a: sweep(function, *a)), (0, 1)))(*arguments)
    plain = jax.jit(jax.grad(total(lambda w, x: jax.vmap(lambda c: function(w, c))(x)), (0, 1)))(*arguments)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), ours, plain)
