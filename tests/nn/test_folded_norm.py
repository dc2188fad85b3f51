"""The folded layers are the plain ones: values, derivatives, and digits far from the origin."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.folded_norm import FoldedMLP
from cmig_jax.nn.mlp import NormedMLP

WIDTHS, GROUPS = (8, 12), 4
FOLDED = FoldedMLP(WIDTHS, GROUPS)
PLAIN = NormedMLP(WIDTHS, use_bias=True, norm="group", groups=GROUPS)


def folded(variables, x):
    return FOLDED.apply(variables, x)


def plain(variables, x):
    return jnp.max(PLAIN.apply(variables, x, train=False), axis=2)


@pytest.fixture(scope="module")
def variables(random_variables):
    """Return parameters, one scale of which is negative."""
    drawn = random_variables(PLAIN, cloud(), train=False)
    drawn["params"]["norm_1"]["scale"][3] *= -1
    return drawn


def cloud(dtype=np.float64):
    return np.random.default_rng(0).normal(size=(2, 7, 5, 6)).astype(dtype)


def test_parameters_are_those_of_the_plain_layers(variables):
    shapes = jax.eval_shape(FOLDED.init, jax.random.key(0), cloud())
    assert jax.tree.map(np.shape, shapes) == jax.tree.map(np.shape, variables)


def test_values_and_derivatives_are_those_of_the_plain_layers(variables):
    with jax.enable_x64(True):
        np.testing.assert_allclose(jax.jit(folded)(variables, cloud()), jax.jit(plain)(variables, cloud()), atol=1e-12)
        weight = np.random.default_rng(1).normal(size=(2, 7, 12))
        of = [jax.jit(jax.grad(lambda *a, f=f: jnp.sum(f(*a) * weight), argnums=(0, 1)))(variables, cloud()) for f in (folded, plain)]
        jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-11), *of)


def test_float32_keeps_its_digits_far_from_the_origin(variables):
    with jax.enable_x64(True):
        exact = np.asarray(jax.jit(plain)(variables, cloud() + 100))
    narrow = jax.tree.map(np.float32, variables)
    found = np.asarray(jax.jit(folded)(narrow, cloud(np.float32) + np.float32(100)))
    assert np.max(np.abs(found - exact)) < 100 * np.finfo(np.float32).eps  # the rounding of the coordinates themselves
