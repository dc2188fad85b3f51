"""The image encoder: shapes, and the stem with one channel for depth views."""

import jax
import numpy as np

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.resnet import IMAGENET_MEAN, IMAGENET_STD, Stem, ViewEncoder

DEPTH = np.random.default_rng(0).integers(0, 256, (2, 1, 3, 20, 20, 1), dtype=np.uint8)
RGB = ((DEPTH.astype(np.float64) / 255 - IMAGENET_MEAN) / IMAGENET_STD).astype(np.float32)
NET = ViewEncoder(widths=(4, 6), blocks=(1, 1))
encode = jax.jit(lambda variables, views: NET.apply(variables, views, train=False))


def test_the_stem_of_depth_equals_that_of_normalised_grey(random_variables):
    stem = Stem(5)
    variables = random_variables(stem, RGB[0, 0], dtype=np.float32)
    y = stem.apply(variables, DEPTH[0, 0])
    assert y.shape == (3, 10, 10, 5)
    np.testing.assert_allclose(y, stem.apply(variables, RGB[0, 0]), atol=2e-5)


def test_views_are_encoded_one_by_one_and_both_kinds_alike(random_variables):
    variables = random_variables(NET, DEPTH, dtype=np.float32, train=False)
    features = encode(variables, DEPTH)
    assert features.shape == (2, 1, 3, 6)
    order = [2, 0, 1]
    np.testing.assert_allclose(encode(variables, DEPTH[::-1, :, order]), features[::-1, :, order], atol=1e-5)
    np.testing.assert_allclose(encode(variables, RGB), features, atol=1e-4)


def test_sizes_are_those_of_resnet_18():
    net, views = ViewEncoder(), jax.ShapeDtypeStruct((2, 224, 224, 1), np.uint8)
    features, variables = jax.eval_shape(lambda x: net.init_with_output(jax.random.key(0), x, train=True), views)
    assert features.shape == (2, 512)
    assert sum(leaf.size for leaf in jax.tree.leaves(variables["params"])) == 11_176_512  # torchvision's, without its classifier


def test_bfloat16_layers_are_pooled_in_float32():
    half = NET.clone(compute=ComputeConfig(precision="bfloat16"))
    features, _ = jax.eval_shape(lambda x: half.init_with_output(jax.random.key(0), x, train=False), DEPTH)
    assert features.dtype == np.float32
