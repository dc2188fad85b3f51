import jax
import jax.numpy as jnp
import numpy as np

from cmig_jax.geometry.maximum import maximum


def test_equals_the_maximum():
    x = jax.random.normal(jax.random.key(0), (2, 5, 3))
    for axis in (0, 1, 2, -1):
        np.testing.assert_array_equal(maximum(x, axis), x.max(axis))


def test_every_maximum_keeps_its_derivative_when_compiled():
    # What comes before the maximum is cheap, so that a compiler may compute it again where the derivative needs it.
    keys = jax.random.split(jax.random.key(1), 4)
    x, scale, mean, bias = (jax.random.normal(key, (6, 50, 32) if i == 0 else (1, 1, 32)) for i, key in enumerate(keys))

    def pooled(x):
        return maximum(jax.nn.relu((x - mean) * scale + bias), 1)

    for function in (jax.grad(lambda x: pooled(x).sum()), jax.jit(jax.grad(lambda x: pooled(x).sum()))):
        gradient = function(x)
        active = np.asarray(pooled(x) > 0)
        np.testing.assert_allclose(gradient.sum(1), np.where(active, np.asarray(scale)[:, 0], 0), rtol=1e-6)
        assert (np.count_nonzero(gradient, axis=1) == active).all()


def test_ties_go_to_the_first():
    gradient = jax.grad(lambda x: maximum(x, 0))(jnp.array([1.0, 2.0, 2.0]))
    np.testing.assert_array_equal(gradient, [0, 1, 0])


def test_tangents_and_second_derivatives():
    x = jnp.array([[0.5, -1.0], [0.2, 3.0]])
    value, tangent = jax.jvp(lambda x: maximum(x**2, 0), (x,), (jnp.ones_like(x),))
    np.testing.assert_allclose(value, [0.25, 9])
    np.testing.assert_allclose(tangent, [1, 6])
    assert jax.hessian(lambda x: maximum(x**2, 0).sum())(x)[0, 0, 0, 0] == 2
