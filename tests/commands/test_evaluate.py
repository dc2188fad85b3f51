"""`evaluate.py` and `cmig evaluate`, as they are typed."""

import json
import shutil
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest

from cmig_jax.commands.evaluate import parse
from cmig_jax.config import FlagError, ViewsConfig
from cmig_jax.config_json import to_json
from cmig_jax.data.pairs import in_categories
from cmig_jax.evaluation.pairs import pairs_to_test
from cmig_jax.inference.load import load
from cmig_jax.inference.run_folder import validation_error
from configs import PRESETS
from configs.catalogue import catalogue

METRICS = {"rmse_r_deg", "mae_r_deg", "rmse_t", "mae_t", "iso_r_deg_median", "recall", "closest_point", "seconds_per_pair"}
METHODS = {"identity", "ICP (cutoff 0.02)", "ICP (tuned)", "ICP (mean pose)", "GICP", "CMIGNet", "CMIGNet + ICP", "CMIGNet + GICP"}
REPORT = ["error_by_category.png", "error_vs_angle.png", "error_vs_overlap.png", "errors.png", "report.html"]


@pytest.fixture(scope="module")
def evaluated(command_line, trained):
    run, _ = trained
    return run, command_line("evaluate.py", run, "--limit", 4, "--batch", 4, "--report", "--report-pairs", 3)


@pytest.fixture(scope="module")
def results(evaluated):
    run, done = evaluated
    assert done.returncode == 0, done.stderr
    return json.loads((run / "evaluation" / "results.json").read_text())


def assert_one_line(done, message):
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr


def test_results_name_every_method_and_metric(results):
    assert set(results) >= METHODS | {"command", "config", "versions"}
    for method in METHODS:
        assert set(results[method]) >= METRICS
        assert results[method]["pairs"] == 4
        assert np.isfinite([results[method][name] for name in METRICS]).all()


def test_results_hold_what_made_them(results, evaluated, tiny):
    assert results["command"] == f"python evaluate.py {evaluated[0]} --limit 4 --batch 4 --report --report-pairs 3"
    assert results["config"]["data"]["points"] == tiny.data.points
    validated = [json.loads(line) for line in (evaluated[0] / "log.jsonl").read_text().splitlines() if "val_rmse_r_deg" in line]
    best = min(validated, key=validation_error)
    assert results["config"]["checkpoint"] == f"best, step {best['step']}"


def test_the_table_is_printed_and_nothing_is_left_over(evaluated):
    run, done = evaluated
    assert all(method in done.stdout for method in METHODS)
    assert f"{run}/evaluation" in done.stdout
    assert {path.name for path in (run / "evaluation").iterdir()} == {
        "curve.png", "errors.npz", "pairs.png", "results.json", "table.md", "table.tex", "views.png", *REPORT
    }  # fmt: skip


def test_the_report_shows_what_was_evaluated(evaluated, results):
    folder = evaluated[0] / "evaluation"
    assert f"report: {folder}/report.html" in evaluated[1].stdout
    page = (folder / "report.html").read_text()
    assert page.count("<article") == page.count('"matches":{') == 3
    assert page.count("<canvas") == page.count("<img") == 6
    assert results["command"] in page
    assert "4 pairs; 48 points sampled once" in page
    for text in (page, (folder / "table.md").read_text(), (folder / "table.tex").read_text()):
        assert all(f"{results[method]['rmse_r_deg']:.2f}" in text for method in METHODS)


def test_a_weights_file_is_evaluated_as_its_run_is(main, trained, results, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main("export", trained[0], "small.npz").returncode == 0
    done = main("evaluate", "small.npz", "--limit", 4, "--batch", 4)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "runs" / "small-weights" / "evaluation" / "results.json").read_text())
    assert found["command"] == "cmig evaluate small.npz --limit 4 --batch 4"
    assert found["config"]["checkpoint"].startswith("small.npz, step ")
    assert found["GICP"]["rmse_r_deg"] == results["GICP"]["rmse_r_deg"], "the same pairs"
    network = load("small.npz", batch=4)
    expected = network([pairs_to_test(network.config, 4)[i] for i in range(4)])
    with np.load(tmp_path / "runs" / "small-weights" / "evaluation" / "errors.npz") as errors:
        np.testing.assert_allclose(errors["CMIGNet/R"], expected.R, atol=1e-5)


def test_keypoints_at_test_may_be_others_than_in_training(main, trained):
    done = main("evaluate", trained[0], "--limit", 1, "--batch", 1, "--out", "all", "--model.keypoints.test-count", 36)
    assert done.returncode == 0, done.stderr
    assert json.loads((trained[0] / "all" / "results.json").read_text())["config"]["model"]["keypoints"]["test_count"] == 36


def test_flags_are_checked_with_the_networks_own(tmp_path):
    """The first preset has six views on the axes, to which seven would not fit."""
    config = replace(PRESETS["quickstart"](), views=ViewsConfig(of="both", layout="ring", count=5, size=32))
    (tmp_path / "config.json").write_text(to_json(config))
    parsed = parse([str(tmp_path), "--views.count", "7"], "cmig evaluate", catalogue)
    assert parsed.config.views == replace(config.views, count=7)
    with pytest.raises(FlagError, match=r"views\.size = 4"):
        parse([str(tmp_path), "--views.size", "4"], "cmig evaluate", catalogue)


def test_without_the_flag_there_is_no_report(main, trained):
    done = main("evaluate", trained[0], "--limit", 1, "--batch", 4, "--out", "plain")
    assert done.returncode == 0, done.stderr
    assert {path.name for path in (trained[0] / "plain").iterdir()}.isdisjoint(REPORT)


def test_a_report_of_no_pair_is_one_line_of_error(main, trained):
    assert_one_line(main("evaluate", trained[0], "--report", "--report-pairs", 0), "report_pairs = 0: expected at least 1 pair")


@pytest.mark.parametrize("out", ["", "../outside", "/outside", "checkpoints"])
def test_results_go_nowhere_else(main, trained, out):
    assert_one_line(main("evaluate", trained[0], "--out", out), f"out = {out!r}: expected the name of a")


def test_register_stands_beside_the_network_if_asked_for(main, trained, tmp_path):
    done = main("evaluate", trained[0], "--limit", 1, "--search", "any", "bound", "--out", "searched")
    assert done.returncode == 0, done.stderr
    results = json.loads((trained[0] / "searched" / "results.json").read_text())
    assert results["config"]["register"] == {"register": "any", "register (within 85.8 deg)": 85.8}
    assert np.isfinite([results[row]["rmse_r_deg"] for row in results["config"]["register"]]).all()
    shutil.rmtree(trained[0] / "searched")


def test_batches_of_no_pair_are_one_line_of_error(main, trained):
    assert_one_line(main("evaluate", trained[0], "--batch", 0), "batch = 0: expected at least 1 pair")


def test_a_run_that_was_stopped_early_is_evaluated_and_says_so(main, trained, tmp_path):
    run = shutil.copytree(trained[0], tmp_path / "stopped")
    (run / "log.jsonl").write_bytes(b"")
    for path in (run / "checkpoints").rglob("metrics/*"):
        path.write_text("{}")
    done = main("evaluate", run, "--limit", 1, "--batch", 4, "--out", "early")
    assert done.returncode == 0, done.stderr
    assert "none of its checkpoints was validated, so this is the last one" in done.stdout
    assert "no training curve: " in done.stdout
    assert json.loads((run / "early" / "results.json").read_text())["config"]["checkpoint"].startswith("last, step ")


@pytest.mark.parametrize("name", ["pairs", "views", "curve"])
def test_the_pictures_show_something(evaluated, name):
    pixels = matplotlib.image.imread(evaluated[0] / "evaluation" / f"{name}.png")[..., :3]
    assert min(pixels.shape[:2]) >= 100
    assert len(np.unique((pixels * 255).astype(np.uint8).reshape(-1, 3), axis=0)) > 20


def test_help_shows_the_run_s_own_data_flags(main, trained):
    done = main("evaluate", trained[0], "--help")
    assert done.returncode == 0
    for flag in ("--which", "--limit", "--batch", "--out", "--report", "--report-pairs", "--data.test-categories", "--data.noise-std"):
        assert flag in done.stdout
    assert "(default: 48)" in done.stdout, "the run's number of points, not the schema's"


def test_flags_may_stand_before_the_run_folder(main, trained):
    done = main("evaluate", "--data.noise-std", -1, trained[0])
    assert_one_line(done, "data.noise_std = -1.0: expected 0 or more")


def test_a_folder_that_is_no_run_is_one_line_of_error(main, tmp_path):
    assert_one_line(main("evaluate", tmp_path), f"{tmp_path}: expected a run folder")


def test_a_run_without_a_checkpoint_is_one_line_of_error(main, trained, tmp_path):
    shutil.copy(trained[0] / "config.json", tmp_path)
    assert_one_line(main("evaluate", tmp_path), f"{tmp_path}/checkpoints: expected checkpoints")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def test_no_pairs_is_one_line_of_error(main, trained):
    assert_one_line(main("evaluate", trained[0], "--limit", 0), "limit = 0: expected at least 1 pair")


def test_a_wrong_flag_names_the_nearest(main, trained):
    done = main("evaluate", trained[0], "--limt", 4)
    assert done.returncode == 2
    assert "--limit" in done.stderr


def test_the_halves_of_the_categories_share_no_object():
    labels = np.array([0, 3, 1, 2, 2, 0])
    first, second = (in_categories(labels, "abcd", half) for half in ("first-half", "second-half"))
    assert first.tolist() == [0, 2, 5]
    assert second.tolist() == [1, 3, 4]
