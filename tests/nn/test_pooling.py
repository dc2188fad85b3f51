"""The stem's maximum against Flax's own, and its derivative against autodiff."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.pooling import max_pool


def plain(x):
    return nn.max_pool(x, (3, 3), (2, 2), padding=((1, 1), (1, 1)))


@pytest.mark.parametrize("shape", [(2, 8, 6, 3), (1, 7, 5, 2), (2, 1, 4, 1)])
@pytest.mark.parametrize("levels", [0, 3])
def test_maximum_and_derivative_are_those_of_the_window_reduction(shape, levels):
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        x = rng.integers(0, levels, shape).astype(np.float64) if levels else rng.normal(size=shape)  # levels: windows with equal pixels
        y, pull = jax.vjp(max_pool, jnp.asarray(x))
        expected, pull_plain = jax.vjp(plain, jnp.asarray(x))
        g = jnp.asarray(rng.normal(size=y.shape))
        np.testing.assert_array_equal(y, expected)
        np.testing.assert_allclose(pull(g)[0], pull_plain(g)[0], atol=1e-14)
