"""Maxima: equal values, derivatives that a compiler could lose, second derivatives."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.ops.pooling import max_pool, maximum


def test_no_derivative_is_lost_when_the_argument_is_computed_twice():
    """The argument is cheap, so that a compiler may compute it again, rounded differently, where the derivative reads it."""
    keys = jax.random.split(jax.random.key(1), 4)
    x, scale, mean, bias = (jax.random.normal(key, (6, 50, 32) if i == 0 else (1, 1, 32)) for i, key in enumerate(keys))

    def pooled(x):
        return maximum(jax.nn.relu((x - mean) * scale + bias), 1, "fast")

    for function in (jax.grad(lambda x: pooled(x).sum()), jax.jit(jax.grad(lambda x: pooled(x).sum()))):
        gradient = function(x)
        active = np.asarray(pooled(x) > 0)
        np.testing.assert_allclose(gradient.sum(1), np.where(active, np.asarray(scale)[:, 0], 0), rtol=1e-6)
        assert (np.count_nonzero(gradient, axis=1) == active).all()


def test_the_derivative_of_equal_values_goes_to_the_first_and_higher_derivatives_exist():
    np.testing.assert_array_equal(jax.grad(lambda x: maximum(x, 0, "fast"))(jnp.array([1.0, 2.0, 2.0])), [0, 1, 0])
    x = jnp.array([[0.5, -1.0], [0.2, 3.0]])
    value, tangent = jax.jvp(lambda x: maximum(x**2, 0, "fast"), (x,), (jnp.ones_like(x),))
    np.testing.assert_allclose(value, [0.25, 9])
    np.testing.assert_allclose(tangent, [1, 6])
    assert jax.hessian(lambda x: maximum(x**2, 0, "fast").sum())(x)[0, 0, 0, 0] == 2


@pytest.mark.parametrize("kernels", ["plain", "fast"])
@pytest.mark.parametrize("shape", [(2, 8, 6, 3), (1, 7, 5, 2), (2, 1, 4, 1)])
def test_windows_with_equal_pixels_send_their_derivative_to_the_first(shape, kernels):
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.integers(0, 3, shape), jnp.float32)
    y, pull = jax.vjp(lambda x: max_pool(x, kernels), x)
    expected, expected_pull = jax.vjp(lambda x: nn.max_pool(x, (3, 3), (2, 2), padding=((1, 1), (1, 1))), x)
    g = jnp.asarray(rng.integers(-4, 5, y.shape), jnp.float32)
    np.testing.assert_array_equal(y, expected)
    np.testing.assert_array_equal(pull(g)[0], expected_pull(g)[0])
