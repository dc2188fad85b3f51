"""The image encoder: shapes, and the summed stem of depth views."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.resnet import IMAGENET_MEAN, IMAGENET_STD, Stem, ViewEncoder

DEPTH = np.random.default_rng(0).integers(0, 256, (2, 1, 3, 20, 20, 1), dtype=np.uint8)
RGB = ((DEPTH.astype(np.float64) / 255 - IMAGENET_MEAN) / IMAGENET_STD).astype(np.float32)
NET = ViewEncoder(widths=(4, 6), blocks=(1, 1))


@jax.jit
def encode(variables, views):
    return NET.apply(variables, views, train=False)


@pytest.fixture(scope="module")
def variables(random_like):
    return random_like(jax.eval_shape(lambda: NET.init(jax.random.key(0), DEPTH, train=False)))


def test_the_summed_stem_of_depth_equals_the_plain_one_of_normalised_grey(random_like):
    stem = Stem(5)
    variables = random_like(jax.eval_shape(stem.init, jax.random.key(0), RGB[0, 0]))
    y = stem.apply(variables, DEPTH[0, 0])
    assert y.shape == (3, 10, 10, 5)
    np.testing.assert_allclose(y, stem.apply(variables, RGB[0, 0]), atol=2e-5)


def test_both_kinds_of_view_give_the_same_features(variables):
    np.testing.assert_allclose(encode(variables, DEPTH), encode(variables, RGB), atol=1e-4)


def test_leading_axes_are_kept_and_views_encoded_one_by_one(variables):
    features = encode(variables, DEPTH)
    assert features.shape == (2, 1, 3, 6)
    order = [2, 0, 1]
    np.testing.assert_allclose(encode(variables, DEPTH[::-1, :, order]), features[::-1, :, order], atol=1e-5)


def test_sizes_are_those_of_resnet_18():
    net = ViewEncoder()
    shapes = jax.eval_shape(
        lambda x: net.init_with_output(jax.random.key(0), x, train=True), jax.ShapeDtypeStruct((2, 224, 224, 1), np.uint8)
    )
    assert shapes[0].shape == (2, 512)
    assert sum(leaf.size for leaf in jax.tree.leaves(shapes[1]["params"])) == 11_176_512  # torchvision's, without its classifier


def test_bfloat16_computes_in_it_and_pools_in_float32(variables):
    shape = jax.eval_shape(lambda: NET.clone(dtype=jnp.bfloat16).apply(variables, DEPTH, train=False))
    assert shape.dtype == jnp.float32
