"""Attention: its formula, large scores, and the type of its derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.config import ComputeConfig
from cmig_jax.ops.attention import attend

KERNELS = pytest.mark.parametrize("compute", [ComputeConfig(kernels="plain"), ComputeConfig(kernels="fast", rows=3)], ids=["plain", "fast"])


def arguments(dtype, scale=1.0):
    """Draw queries, keys and values of another width."""
    shapes = (1, 2, 4, 8), (1, 2, 5, 8), (1, 2, 5, 3)
    query, key, value = (np.random.default_rng(seed).normal(size=shape) for seed, shape in enumerate(shapes))
    return tuple(jnp.asarray(x, dtype) for x in (scale * query, scale * key, value))


@KERNELS
def test_values_equal_the_formula(compute):
    query, key, value = arguments(jnp.float32)
    scores = np.einsum("bhnc,bhmc->bhnm", query, key) / np.sqrt(8)
    weights = np.exp(scores) / np.exp(scores).sum(-1, keepdims=True)
    np.testing.assert_allclose(attend(query, key, value, compute), weights @ np.asarray(value), atol=1e-6)


@KERNELS
def test_large_scores_overflow_nothing_and_bfloat16_gradients_keep_their_type(compute):
    value, gradients = jax.value_and_grad(lambda a: jnp.sum(attend(*a, compute)))(arguments(jnp.float32, scale=1e3))
    assert all(np.all(np.isfinite(g)) for g in (value, *gradients))
    gradients = jax.eval_shape(jax.grad(lambda a: jnp.sum(attend(*a, compute).astype(jnp.float32))), arguments(jnp.bfloat16))
    assert {g.dtype for g in gradients} == {jnp.dtype(jnp.bfloat16)}
