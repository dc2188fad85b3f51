"""Convolutions and their derivatives equal XLA's own, in float64, at odd and even sizes, whole and in chunks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn import convolution
from cmig_jax.nn.convolution import convolve
from cmig_jax.training.mesh import device_mesh, sharing

CASES = {
    "Winograd": (3, 1, (6, 8), 3, 5),
    "Winograd, odd size": (3, 1, (7, 5), 3, 5),
    "3 x 3, stride 2": (3, 2, (6, 7), 3, 5),
    "shortcut": (1, 2, (6, 7), 3, 5),
    "stem": (7, 2, (9, 12), 1, 4),
    "stem of colours": (7, 2, (9, 12), 3, 4),
}


def drawn(case, images=4):
    size, stride, shape, inputs, outputs = CASES[case]
    rng = np.random.default_rng(0)
    return stride, rng.normal(size=(images, *shape, inputs)), rng.normal(size=(size, size, inputs, outputs))


def plain(x, kernel, stride):
    pad = kernel.shape[0] // 2
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), [(pad, pad)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC"))


def with_derivatives(function, x, kernel, stride):
    """Return the result and its derivatives along one direction drawn at random."""
    y, pull = jax.vjp(lambda x, kernel: function(x, kernel, stride), x, kernel)
    return y, *pull(np.random.default_rng(1).normal(size=y.shape).astype(y.dtype))


@pytest.mark.parametrize("numbers", [2**20, 1], ids=["whole", "image by image"])
@pytest.mark.parametrize("case", CASES)
def test_result_and_derivatives_are_those_of_the_plain_convolution(case, numbers, monkeypatch):
    monkeypatch.setattr(convolution, "NUMBERS_AT_A_TIME", numbers)
    stride, x, kernel = drawn(case)
    with jax.enable_x64(True):
        found, expected = (with_derivatives(f, jnp.asarray(x), jnp.asarray(kernel), stride) for f in (convolve, plain))
        for ours, theirs in zip(found, expected, strict=True):
            assert ours.dtype == jnp.float64
            np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_winograd_rounds_like_the_plain_sum():
    """Both in float32, against float64, at the widest of ResNet-18's layers."""
    rng = np.random.default_rng(0)
    x, kernel = rng.normal(size=(1, 8, 8, 512)), rng.normal(size=(3, 3, 512, 32)) / np.sqrt(9 * 512)
    with jax.enable_x64(True):
        exact = plain(jnp.asarray(x), jnp.asarray(kernel), 1)
        narrow = jnp.asarray(x, jnp.float32), jnp.asarray(kernel, jnp.float32)
        ours, theirs = (np.abs(f(*narrow, 1) - exact).max() for f in (convolve, plain))
    assert 0 < ours < 8 * theirs


def test_half_precision_takes_the_plain_convolution():
    stride, x, kernel = drawn("Winograd")
    x, kernel = jnp.asarray(x, jnp.bfloat16), jnp.asarray(kernel, jnp.bfloat16)
    np.testing.assert_array_equal(convolve(x, kernel, stride), plain(x, kernel, stride))


@pytest.mark.parametrize("case", ["Winograd", "stem"])
def test_each_of_eight_devices_convolves_its_own_images(case):
    stride, x, kernel = drawn(case, images=8)
    x, kernel, mesh = jnp.asarray(x, jnp.float32), jnp.asarray(kernel, jnp.float32), device_mesh(8, 8)

    def shared(x, kernel):
        with sharing(mesh):
            return with_derivatives(convolve, x, kernel, stride)

    compiled = jax.jit(shared, in_shardings=(jax.NamedSharding(mesh, jax.P("batch")), jax.NamedSharding(mesh, jax.P()))).lower(x, kernel)
    compiled = compiled.compile()
    assert "all-gather" not in compiled.as_text()
    for ours, theirs in zip(compiled(x, kernel), with_derivatives(plain, x, kernel, stride), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_images_that_the_devices_cannot_share_are_convolved_by_all():
    stride, x, kernel = drawn("stem", images=1)
    with sharing(device_mesh(8, 8)):
        found = jax.jit(convolve, static_argnums=2)(jnp.asarray(x, jnp.float32), jnp.asarray(kernel, jnp.float32), stride)
    np.testing.assert_allclose(found, plain(x.astype(np.float32), kernel.astype(np.float32), stride), atol=1e-4)
