"""Which pairs the report shows, and what it keeps of them."""

import base64
import io

import matplotlib.image
import numpy as np
import pytest

from cmig_jax.report.gallery import LARGEST, MAX_POINTS, choose, contact_sheet, describe


@pytest.mark.parametrize(("pairs", "count"), [(200, 20), (21, 20), (201, 7), (50, 3), (9, 2)])
def test_the_worst_then_down_to_the_best(pairs, count):
    errors = np.random.default_rng(0).permutation(pairs)
    positions, ranks = np.array(choose(errors, count)).T
    assert len(ranks) == len(set(positions)) == count
    assert (np.sort(errors)[::-1][ranks] == errors[positions]).all(), "a rank is that of its pair"
    assert (np.diff(ranks) > 0).all()
    assert ranks[: (count + 1) // 2].tolist() == list(range((count + 1) // 2))
    assert ranks[-1] == pairs - 1
    assert count < 4 or (pairs - 1) // 2 in ranks, "the median"


@pytest.mark.parametrize("count", [5, 9])
def test_all_where_there_are_not_more(count):
    assert choose([1.0, 3.0, 2.0, 3.0, 0.0], count) == [(1, 0), (3, 1), (2, 2), (0, 3), (4, 4)]


def test_no_pair_is_an_error():
    with pytest.raises(ValueError, match="report_pairs = 0: expected at least 1"):
        choose([1.0], 0)


def test_one_pair_is_the_worst():
    assert choose([1.0, 3.0, 2.0], 1) == [(1, 0)]


def decode(text: str, scale: float) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<i2").reshape(-1, 3) * scale


def test_coordinates_survive_to_half_a_step(make_errors, make_example):
    errors = make_errors()
    example = make_example(errors, 3, 0)
    example.pair["source"][7] = [5.0, -6.0, 0.0]
    described = describe(example, errors)
    scale = described["scale"]
    assert scale <= 12 / LARGEST
    for cloud in ("source", "target"):
        np.testing.assert_allclose(decode(described[cloud], scale), example.pair[cloud], rtol=0, atol=0.501 * scale)
    matched = described["matches"]
    np.testing.assert_allclose(decode(matched["target"], scale), example.matches.target, rtol=0, atol=0.501 * scale)
    assert matched["chosen"] == example.matches.chosen.tolist()
    assert matched["right"] == example.matches.right.tolist()
    for name, pose in described["poses"].items():
        np.testing.assert_allclose(pose[:9], errors.methods[name].R[3].ravel(), atol=1e-6)
        np.testing.assert_allclose(pose[9:], errors.methods[name].t[3], atol=1e-6)


def test_a_pair_without_correspondences_and_one_at_the_origin(make_errors, make_example):
    errors = make_errors()
    example = make_example(errors, 3, 0, matched=False)
    for cloud in ("source", "target"):
        example.pair[cloud] = np.zeros((4, 3), np.float32)
    described = describe(example, errors)
    assert "matches" not in described
    assert not decode(described["source"], described["scale"]).any()


def test_a_large_cloud_is_thinned(make_errors, make_example):
    errors = make_errors()
    described = describe(make_example(errors, 3, 0, points=MAX_POINTS + 100), errors)
    assert len(decode(described["source"], 1.0)) == MAX_POINTS


@pytest.mark.parametrize(("shape", "width"), [((6, 32, 32), 2 * (6 * 34 - 2)), ((20, 224, 224), 10 * 77 - 2), ((1, 96, 96), 96)])
def test_a_contact_sheet(shape, width):
    views = np.zeros(shape, np.uint8)
    views[0] = 255
    sheet, shown = contact_sheet(views)
    pixels = matplotlib.image.imread(io.BytesIO(sheet))[..., :3]
    assert shown == width
    assert pixels[5, 5].max() < 0.3, "near is dark"
    dark = np.mean(pixels.max(-1) < 0.5)
    np.testing.assert_allclose(dark, 1 / len(views), rtol=0.5)
    assert len(views) == 1 or (pixels[5, -5] == 1).all(), "background is white"
