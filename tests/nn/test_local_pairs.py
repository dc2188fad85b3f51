"""Local features of point pairs: no motion of the cloud, order of its points or side of a normal changes them; lengths and angles do."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.nn.local_pairs import LocalPairs

NET = LocalPairs(k=6, widths=(8, 16))


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def cloud():
    rng = np.random.default_rng(0)
    points, normals = rng.normal(size=(2, 3, 40, 3))
    return points, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


@pytest.fixture
def encode(cloud, random_variables):
    variables = random_variables(NET, *cloud)
    return lambda *x: np.asarray(NET.apply(variables, *x))


def test_neither_a_motion_nor_the_side_of_a_normal_changes_a_feature(cloud, encode):
    points, normals = cloud
    rng = np.random.default_rng(1)
    R = Rotation.random(3, rng=rng).as_matrix()
    moved = np.einsum("bij,bnj->bni", R, points) + rng.normal(size=(3, 1, 3))
    turned = np.einsum("bij,bnj->bni", R, normals) * rng.choice([-1.0, 1.0], (3, 40, 1))
    features = encode(points, normals)
    assert features.shape == (3, 40, 16)
    assert np.ptp(features, axis=1).max() > 0.1
    np.testing.assert_allclose(encode(moved, turned), features, atol=1e-9)


def test_a_feature_follows_its_point_and_sees_lengths_and_angles(cloud, encode):
    points, normals = cloud
    features, order = encode(points, normals), np.random.default_rng(2).permutation(40)
    np.testing.assert_allclose(encode(points[:, order], normals[:, order]), features[:, order], atol=1e-9)
    assert np.abs(encode(1.2 * points, normals) - features).max() > 1e-3
    assert np.abs(encode(points, np.roll(normals, 1, axis=-1)) - features).max() > 1e-3
