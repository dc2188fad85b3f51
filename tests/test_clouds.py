"""The check of a cloud: what it accepts, and that each refusal names the cloud, its value and what was expected."""

import numpy as np
import pytest

from cmig_jax.clouds import check_cloud, thinned

BAD_ROW = np.zeros((20, 3))
BAD_ROW[[4, 7]] = [[0, np.nan, 1], [np.inf, 0, 0]]
MASKED = np.ma.array(np.zeros((2, 3)), mask=[[0, 0, 1], [0, 0, 0]])


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.int8, np.int64, np.uint16])
def test_real_numbers_become_float64(dtype):
    cloud = check_cloud(np.arange(12, dtype=dtype).reshape(4, 3))
    assert cloud.dtype == np.float64
    np.testing.assert_array_equal(cloud, np.arange(12.0).reshape(4, 3))


def test_lists_and_any_layout_are_accepted():
    for points in ([[1, 2, 3], [4, 5, 6.5]], ((1, 2, 3), (4, 5, 6.5)), np.asfortranarray([[1, 2, 3], [4, 5, 6.5]])):
        cloud = check_cloud(points)
        np.testing.assert_array_equal(cloud, [[1, 2, 3], [4, 5, 6.5]])
        assert cloud.flags.c_contiguous
    np.testing.assert_array_equal(check_cloud(np.ma.array(np.ones((2, 3)), mask=False)), np.ones((2, 3)))


def test_float64_keeps_every_digit():
    points = np.random.default_rng(0).normal(size=(50, 3)) + 5e6
    np.testing.assert_array_equal(check_cloud(points), points)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (MASKED, "1 masked values; expected none"),
        ([[1, 2, 3], [4, 5]], r"expected \[N, 3\] numbers \(.*inhomogeneous"),
        (np.array([[1, 2, None]]), r"shape \(1, 3\), object; expected \[N, 3\] real numbers"),
        ([["1", "2", "3"]], r"shape \(1, 3\), <U1; expected"),
        (np.zeros((5, 3), bool), r"shape \(5, 3\), bool; expected"),
        (np.zeros((5, 3), complex), r"shape \(5, 3\), complex128; expected"),
        (np.zeros((3, 20)), r"shape \(3, 20\), float64; expected \[N, 3\]"),
        (np.zeros((20, 4)), r"shape \(20, 4\), float64; expected \[N, 3\]"),
        (np.zeros((2, 20, 3)), r"shape \(2, 20, 3\), float64; expected"),
        (None, r"shape \(\), object; expected"),
        (np.zeros((0, 3)), "0 points; expected at least 2"),
        (np.zeros((1, 3)), "1 points; expected at least 2"),
        (BAD_ROW, r"point 4 is \[0\.0, nan, 1\.0\]; expected finite coordinates \(2 of 20 points have others\)"),
    ],
)
def test_a_refusal_names_cloud_value_and_what_was_expected(points, message):
    with pytest.raises(ValueError, match=rf"^scan\.ply: {message}"):
        check_cloud(points, "scan.ply", fewest=2)


def test_a_large_cloud_is_thinned_to_the_same_points_in_their_order():
    points = np.arange(60.0).reshape(20, 3)
    fewer = thinned(points, 7, seed=1)
    np.testing.assert_array_equal(fewer, thinned(points, 7, seed=1))
    assert len(np.unique(fewer[:, 0])) == 7
    assert (np.diff(fewer[:, 0]) > 0).all()
    assert thinned(points, 20) is points
