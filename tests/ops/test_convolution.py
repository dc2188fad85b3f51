"""Convolutions: even sizes, chunks with and without padding, rounding, half precision, several devices."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.devices import device_mesh, sharing
from cmig_jax.ops import convolution
from cmig_jax.ops.convolution import convolve

# Size of the kernel, stride, height and width, input channels, output channels.
CASES = {"Winograd": (3, 1, (6, 8), 3, 5), "stem": (7, 2, (9, 12), 1, 4)}
fast, plain = (partial(convolve, kernels=kernels) for kernels in ("fast", "plain"))


def random_case(name, images, dtype=np.float64):
    size, stride, shape, inputs, outputs = CASES[name]
    rng = np.random.default_rng(0)
    x, kernel = rng.normal(size=(images, *shape, inputs)), rng.normal(size=(size, size, inputs, outputs))
    return jnp.asarray(x, dtype), jnp.asarray(kernel, dtype), stride


def with_derivatives(function, x, kernel, stride):
    """Return the result and its derivatives along one random direction."""
    y, pull = jax.vjp(lambda x, kernel: function(x, kernel, stride), x, kernel)
    return y, *pull(np.random.default_rng(1).normal(size=y.shape).astype(y.dtype))


@pytest.mark.parametrize("images_per_chunk", [5, 2, 1])
@pytest.mark.parametrize("name", CASES)
def test_chunks_of_images_equal_the_plain_convolution(name, images_per_chunk, monkeypatch):
    """Five images in one chunk, in three of which the last is padded, and one by one."""
    monkeypatch.setattr(convolution, "_images_per_chunk", lambda x, numbers: images_per_chunk)
    with jax.enable_x64(True):
        case = random_case(name, images=5)
        run = jax.jit(with_derivatives, static_argnums=(0, 3))
        for found, expected in zip(run(fast, *case), run(plain, *case), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-12)


def test_winograd_rounds_like_the_plain_sum():
    """Both in float32, against float64, at the widest of ResNet-18's layers."""
    rng = np.random.default_rng(0)
    x, kernel = rng.normal(size=(1, 8, 8, 512)), rng.normal(size=(3, 3, 512, 32)) / np.sqrt(9 * 512)
    with jax.enable_x64(True):
        exact = plain(jnp.asarray(x), jnp.asarray(kernel))
        single = jnp.asarray(x, jnp.float32), jnp.asarray(kernel, jnp.float32)
        error, plain_error = (np.abs(f(*single) - exact).max() for f in (fast, plain))
    assert 0 < error < 8 * plain_error


def test_half_precision_takes_the_plain_convolution():
    case = random_case("Winograd", 4, jnp.bfloat16)
    np.testing.assert_array_equal(fast(*case), plain(*case))


@pytest.mark.parametrize("name", CASES)
def test_each_of_eight_devices_convolves_its_own_images(name):
    x, kernel, stride = random_case(name, 8, np.float32)
    mesh = device_mesh(8, 8)

    def shared(x, kernel):
        with sharing(mesh):
            return with_derivatives(fast, x, kernel, stride)

    compiled = jax.jit(shared, in_shardings=(jax.NamedSharding(mesh, jax.P("batch")), jax.NamedSharding(mesh, jax.P()))).lower(x, kernel)
    compiled = compiled.compile()
    assert "all-gather" not in compiled.as_text()
    for found, expected in zip(compiled(x, kernel), with_derivatives(plain, x, kernel, stride), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_a_number_of_images_that_the_devices_do_not_divide_is_convolved_by_all():
    x, kernel, stride = random_case("stem", 1, np.float32)
    with sharing(device_mesh(8, 8)):
        found = jax.jit(fast, static_argnums=2)(x, kernel, stride)
    np.testing.assert_allclose(found, plain(x, kernel, stride), atol=1e-4)
