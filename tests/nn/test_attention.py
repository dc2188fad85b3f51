"""Attention against its formula; equal tokens act as one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.attention import Attention, PairTransformer, attend
from cmig_jax.nn.fusion import CrossAttention


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


run = jax.jit(lambda layer, variables, x, memory: layer.apply(variables, x, memory), static_argnums=0)
LAYERS = pytest.mark.parametrize("layer", [PairTransformer(dim=8, heads=2, feed_forward=6), CrossAttention(dim=8)], ids=["pair", "cross"])


@pytest.fixture(scope="module")
def init(random_like):
    return lambda layer, x, memory: random_like(jax.eval_shape(layer.init, jax.random.key(0), x, memory), dtype=np.float64)


def naive(query, key, value):
    scores = jnp.einsum("bhnc,bhmc->bhnm", query, key) / np.sqrt(query.shape[-1])
    return jnp.einsum("bhnm,bhmd->bhnd", jax.nn.softmax(scores, axis=-1), value)


@pytest.mark.parametrize("rows", [0, 3, 7])
def test_attend_and_its_gradients_equal_the_formula(rows):
    arguments = normal(2, 3, 7, 4), normal(2, 3, 9, 4, seed=1), normal(2, 3, 9, 5, seed=2)
    cotangent = normal(2, 3, 7, 5, seed=3)

    @jax.jit
    def value_and_gradients(arguments):
        value, pull = jax.vjp(lambda *a: attend(*a, rows), *arguments)
        expected, expected_pull = jax.vjp(naive, *arguments)
        return (value, *pull(cotangent)), (expected, *expected_pull(cotangent))

    for ours, expected in zip(*value_and_gradients(arguments), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-12)


def test_large_scores_overflow_nothing():
    arguments = 1e3 * normal(1, 1, 4, 8), 1e3 * normal(1, 1, 5, 8, seed=1), normal(1, 1, 5, 8, seed=2)
    value, gradients = jax.jit(jax.value_and_grad(lambda a: jnp.sum(attend(*a))))(arguments)
    assert all(np.all(np.isfinite(g)) for g in (value, *gradients))


def test_bfloat16_gradients_keep_their_dtype():
    arguments = tuple(normal(1, 1, 4, 8, seed=s).astype(jnp.bfloat16) for s in range(3))
    gradients = jax.eval_shape(jax.grad(lambda a: jnp.sum(attend(*a).astype(jnp.float32))), arguments)
    assert {g.dtype for g in gradients} == {jnp.dtype(jnp.bfloat16)}


def test_heads_attend_apart(init):
    x, memory = normal(2, 7, 8), normal(2, 9, 8, seed=1)
    layer = Attention(dim=8, heads=2)
    variables = init(layer, x, memory)
    p = jax.tree.map(np.asarray, variables["params"])

    def dense(name, y):
        return np.asarray(y) @ p[name]["kernel"] + p[name]["bias"]

    q, k, v = dense("query", x), dense("key", memory), dense("value", memory)
    heads = [naive(*(y[:, None, :, s] for y in (q, k, v)))[:, 0] for s in (slice(0, 4), slice(4, 8))]
    np.testing.assert_allclose(run(layer, variables, x, memory), dense("out", np.concatenate(heads, -1)), atol=1e-12)


@LAYERS
def test_equal_tokens_act_as_one(layer, init):
    points, token = normal(2, 7, 8), normal(2, 1, 8, seed=1)
    variables = init(layer, points, token)
    one = run(layer, variables, points, token)
    np.testing.assert_allclose(run(layer, variables, points, token.repeat(6, axis=1)), one, atol=1e-12)
    if isinstance(layer, CrossAttention):
        assert np.ptp(one, axis=1).max() < 1e-12, "every point receives the same vector"


@LAYERS
def test_points_keep_their_order_and_tokens_have_none(layer, init):
    points, tokens = normal(2, 7, 8), normal(2, 6, 8, seed=1)
    variables = init(layer, points, tokens[:, :1])
    y = run(layer, variables, points, tokens)
    assert np.ptp(y, axis=1).max() > 1e-6
    order, other = np.random.default_rng(2).permutation(7), np.random.default_rng(3).permutation(6)
    np.testing.assert_allclose(run(layer, variables, points[:, order], tokens[:, other]), y[:, order], atol=1e-12)
    np.testing.assert_allclose(run(layer.clone(rows=2), variables, points, tokens), y, atol=1e-12)
