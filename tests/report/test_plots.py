"""The pictures are written, show what they are given, and leave no global state behind."""

import json

import matplotlib.image
import numpy as np
import pytest

from cmig_jax.report.plots import plot_curve, plot_pairs, plot_views


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
    pair = make_pair(True)
    del pair["correct"]
    plot_pairs([pair], tmp_path / "unknown.png")
    assert share_of_colour(tmp_path / "unknown.png", red) < 1e-4


def training_line(step: int, **more: float) -> str:
    return json.dumps({"step": step, "epoch": 0, "loss": 3.0 / step, "matching_0": 1.0 / step, "matching_1": 1.0 / step, **more})


def size(path):
    return matplotlib.image.imread(path).shape[:2]


def test_curve(tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text("\n".join(training_line(step) for step in range(1, 300)))
    plot_curve(log, tmp_path / "one.png")
    log.write_text(log.read_text() + '\n{"step": 299, "val_rmse_r_deg": 4.0, "val_mae_r_deg": NaN}\n{"step": 30')
    plot_curve(log, tmp_path / "two.png")
    assert size(tmp_path / "two.png")[1] > size(tmp_path / "one.png")[1]


def test_curve_of_one_step_and_of_a_negative_loss(tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text(training_line(1))
    plot_curve(log, tmp_path / "one.png")
    log.write_text(training_line(1) + "\n" + training_line(2, cross_modal=-0.5))
    plot_curve(log, tmp_path / "negative.png")
    assert (tmp_path / "negative.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "at least one line with a loss"),
        ('{"step": 1, "val_rmse_r_deg": 3}\n', "at least one line with a loss"),
        (f"nonsense\n{training_line(1)}\n", "line 1.*nonsense"),
        (f'{{"loss": 1}}\n{training_line(1)}\n', "line 1"),
        (f"[1]\n{training_line(1)}\n", "line 1"),
    ],
)
def test_a_broken_log_is_named(tmp_path, text, message):
    (tmp_path / "log.jsonl").write_text(text)
    with pytest.raises(ValueError, match=rf"log\.jsonl.*{message}"):
        plot_curve(tmp_path / "log.jsonl", tmp_path / "curve.png")
    assert not (tmp_path / "curve.png").exists()


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
