"""The training curve is drawn from a log, also of a run that was interrupted; a broken log is named."""

import json

import matplotlib.image
import pytest

from cmig_jax.report.curve import plot_curve


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
