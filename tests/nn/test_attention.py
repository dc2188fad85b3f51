"""Layers of attention: heads, equal tokens, order. `tests/ops` has the operation itself."""

import jax
import numpy as np
import pytest

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.attention import Attention, CrossAttention, PairTransformer
from cmig_jax.ops.attention import attend

run = jax.jit(lambda layer, variables, x, memory: layer.apply(variables, x, memory), static_argnums=0)
LAYERS = pytest.mark.parametrize("layer", [PairTransformer(dim=8, heads=2, feed_forward=6), CrossAttention(dim=8)], ids=["pair", "cross"])


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def test_heads_attend_apart(random_variables):
    x, memory, layer = normal(2, 7, 8), normal(2, 9, 8, seed=1), Attention(dim=8, heads=2)
    variables = random_variables(layer, x, memory)
    p = variables["params"]

    def dense(name, y):
        return np.asarray(y) @ p[name]["kernel"] + p[name]["bias"]

    q, k, v = dense("query", x), dense("key", memory), dense("value", memory)
    heads = [attend(*(y[..., s] for y in (q, k, v)), ComputeConfig(kernels="plain")) for s in (slice(0, 4), slice(4, 8))]
    np.testing.assert_allclose(run(layer, variables, x, memory), dense("out", np.concatenate(heads, -1)), atol=1e-12)


@LAYERS
def test_equal_tokens_act_as_one(layer, random_variables):
    points, token = normal(2, 7, 8), normal(2, 1, 8, seed=1)
    variables = random_variables(layer, points, token)
    one = run(layer, variables, points, token)
    np.testing.assert_allclose(run(layer, variables, points, token.repeat(6, axis=1)), one, atol=1e-12)
    if isinstance(layer, CrossAttention):
        assert np.ptp(one, axis=1).max() < 1e-12, "every point receives the same vector"


@LAYERS
def test_points_keep_their_order_and_tokens_have_none(layer, random_variables):
    points, tokens = normal(2, 7, 8), normal(2, 6, 8, seed=1)
    variables = random_variables(layer, points, tokens)
    y = run(layer, variables, points, tokens)
    assert np.ptp(y, axis=1).max() > 1e-6
    order, other = np.random.default_rng(2).permutation(7), np.random.default_rng(3).permutation(6)
    np.testing.assert_allclose(run(layer, variables, points[:, order], tokens[:, other]), y[:, order], atol=1e-12)
    np.testing.assert_allclose(run(layer.clone(compute=ComputeConfig(rows=2)), variables, points, tokens), y, atol=1e-12)
