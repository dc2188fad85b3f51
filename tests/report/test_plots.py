"""The pictures are written, show what they are given, and leave no global state behind."""

import matplotlib.image
import numpy as np
import pytest

from cmig_jax.report.plots import plot_pairs, plot_views


def make_pair(matched: bool) -> dict:
    rng = np.random.default_rng(0)
    source = rng.normal(size=(60, 3))
    pair = {"source": source, "target": source[:50] + 0.5, "R": np.eye(3), "t": np.full(3, 0.5), "title": "chair"}
    if matched:
        pair |= {"source_keypoints": source[:45], "target_keypoints": source[:45] + 0.5, "correct": np.arange(45) % 3 > 0}
    return pair


def share_of_colour(path, rgb, tolerance=0.08):
    return np.mean(np.abs(matplotlib.image.imread(path)[..., :3] - np.array(rgb)).max(-1) < tolerance)


@pytest.mark.parametrize("count", [1, 3, 5])
def test_pairs(tmp_path, count):
    plot_pairs([make_pair(False)] * count, tmp_path / "pairs.png", up="y")
    assert share_of_colour(tmp_path / "pairs.png", (0.89, 0.54, 0.29)) > 2e-4, "the source's points"
    assert share_of_colour(tmp_path / "pairs.png", (0.29, 0.46, 0.62)) > 2e-4, "the target's points"


def test_matches_are_coloured_by_whether_they_are_right(tmp_path):
    green, red = (0.33, 0.64, 0.48), (0.69, 0.25, 0.36)
    plot_pairs([make_pair(True)], tmp_path / "matched.png")
    plot_pairs([make_pair(False)], tmp_path / "plain.png")
    for colour in (green, red):
        assert share_of_colour(tmp_path / "matched.png", colour) > 1e-3
        assert share_of_colour(tmp_path / "plain.png", colour) < 1e-4


@pytest.mark.parametrize("count", [1, 6, 20])
def test_views(tmp_path, count):
    views = np.zeros((count, 32, 32), np.uint8)
    views[:, 8:24, 8:24] = 255
    plot_views(views, tmp_path / "views.png", title="chair")
    near = share_of_colour(tmp_path / "views.png", (0.06, 0.17, 0.27))
    assert 0.1 < near < 0.25, "a quarter of every view is near"


def test_nothing_to_draw_is_an_error(tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        plot_pairs([], tmp_path / "pairs.png")
    for views in (np.zeros((0, 8, 8)), np.zeros((8, 8))):
        with pytest.raises(ValueError, match=r"\[V, H, W\]"):
            plot_views(views, tmp_path / "views.png")
    assert not list(tmp_path.iterdir())
