"""Normalisation as PyTorch defines it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.norm import BatchNorm, LayerNorm

RNG = np.random.default_rng(0)
X = (3 + 2 * RNG.normal(size=(4, 5, 6))).astype(np.float32)
SCALE, BIAS = RNG.normal(size=(2, 6)).astype(np.float32)
MEAN, VARIANCE = RNG.normal(size=6).astype(np.float32), RNG.uniform(0.5, 2, 6).astype(np.float32)
NORM = BatchNorm(6)
VARIABLES = {"params": {"scale": SCALE, "bias": BIAS}, "batch_stats": {"mean": MEAN, "var": VARIANCE}}


@jax.jit
def train(x):
    y, state = NORM.apply(VARIABLES, x, train=True, mutable=["batch_stats"])
    return y, state["batch_stats"]


def test_batch_statistics_normalise_in_training():
    y, _ = train(X)
    expected = (X - X.mean((0, 1))) / np.sqrt(X.var((0, 1)) + 1e-5) * SCALE + BIAS
    np.testing.assert_allclose(y, expected, atol=1e-5)


def test_running_statistics_normalise_in_evaluation():
    y = NORM.apply(VARIABLES, X, train=False)
    np.testing.assert_allclose(y, (X - MEAN) / np.sqrt(VARIANCE + 1e-5) * SCALE + BIAS, atol=1e-5)


def test_a_tenth_of_mean_and_unbiased_variance_is_recorded():
    _, stats = train(X)
    np.testing.assert_allclose(stats["mean"], 0.9 * MEAN + 0.1 * X.mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(stats["var"], 0.9 * VARIANCE + 0.1 * X.var((0, 1), ddof=1), rtol=1e-5)


def test_initialisation_records_nothing():
    stats = NORM.init(jax.random.key(0), X, train=True)["batch_stats"]
    np.testing.assert_array_equal(stats["mean"], np.zeros(6))
    np.testing.assert_array_equal(stats["var"], np.ones(6))


def test_training_does_not_depend_on_shift_and_scale_of_the_channels():
    y, _ = train(X)
    z, _ = train(7 * X - 3)
    np.testing.assert_allclose(y, z, atol=1e-4)


def test_constant_channels_and_a_single_value_give_the_bias_and_a_finite_gradient():
    def total(x):
        return jnp.sum(train(x)[0] ** 2)

    y, stats = train(X[:1, :1])
    np.testing.assert_allclose(y[0, 0], BIAS, atol=1e-6)
    assert np.all(np.isfinite(stats["var"]))
    assert np.all(np.isfinite(jax.jit(jax.grad(total))(np.ones((4, 5, 6), np.float32))))


@pytest.mark.parametrize("layer", [NORM, LayerNorm()])
def test_bfloat16_stays_bfloat16_and_statistics_float32(layer):
    arguments = {"train": True} if layer is NORM else {}
    y, variables = jax.eval_shape(lambda: layer.init_with_output(jax.random.key(0), X.astype(jnp.bfloat16), **arguments))
    assert y.dtype == jnp.bfloat16
    assert {v.dtype for v in jax.tree.leaves(variables)} == {jnp.dtype("float32")}


def test_layer_norm_has_the_unbiased_deviation_and_epsilon_outside_the_root():
    x = 1e-6 * X  # where epsilon counts
    y = LayerNorm().apply({"params": {"scale": SCALE, "bias": BIAS}}, x)
    deviation = x.std(-1, ddof=1, keepdims=True)
    np.testing.assert_allclose(y, SCALE * (x - x.mean(-1, keepdims=True)) / (deviation + 1e-6) + BIAS, atol=1e-5)


def test_layer_norm_of_a_constant_is_the_bias_with_a_finite_gradient():
    constant = np.full((2, 6), 0.3, np.float32)
    params = {"scale": SCALE, "bias": BIAS}
    np.testing.assert_allclose(LayerNorm().apply({"params": params}, constant), BIAS[None].repeat(2, 0), atol=1e-6)
    gradients = jax.jit(jax.grad(lambda p, x: jnp.sum(LayerNorm().apply({"params": p}, x) ** 2), argnums=(0, 1)))(params, constant)
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(gradients))
