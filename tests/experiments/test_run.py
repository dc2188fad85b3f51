"""Experiments from their command to their table, at toy size. Two rows are run each time, and one of their networks on recorded pairs; all
others, a compilation or two for each row, by `pytest -m slow tests/experiments`. `test_rows.py` traces every row each time."""

import json
import shutil
from dataclasses import replace

import h5py
import jax
import numpy as np
import pytest

from cmig_jax import cli
from cmig_jax.data.protocol import SYMMETRIC
from configs.catalogue import catalogue
from configs.experiments import EXPERIMENTS, NOISE, OBSERVED, Experiment, Row

SHORT = {"model.fusion.image": "none", "model.loss.cross_modal": "off", "model.matching.iterations": 1}
CATEGORIES = (*SYMMETRIC, "chair", "desk", "door", "sofa")


def main(arguments):
    return cli.main(["experiments", *arguments], catalogue)


@pytest.fixture(scope="session")
def objects(tmp_path_factory):
    """A ModelNet40 folder with its symmetric categories and four others, 4 objects each to train on and 1 to test on."""
    root, rng = tmp_path_factory.mktemp("objects"), np.random.default_rng(0)
    (root / "shape_names.txt").write_text("\n".join(CATEGORIES) + "\n")
    for split, each in (("train", 4), ("test", 1)):
        labels = np.repeat(np.arange(len(CATEGORIES)), each)
        points = rng.normal(size=(len(labels), 96, 3)) * rng.uniform(0.3, 1, (len(labels), 1, 3))
        points /= np.linalg.norm(points, axis=-1).max(axis=1)[:, None, None]
        with h5py.File(root / f"ply_data_{split}0.h5", "w") as file:
            file["data"], file["label"] = points.astype(np.float32), labels[:, None].astype(np.uint8)
    return root


@pytest.fixture(scope="session")
def run(objects, scans, scenes):
    """Run experiments with their data, and all they write, in a folder; return the exit code."""

    def call(folder, *arguments):
        places = ("--data", objects, "--stanford", scans, "--sevenscenes", scenes, "--runs", folder / "runs")
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)  # prepared data goes to data/
            return main(["run", *map(str, arguments), "--scale", "toy", *map(str, places)])

    return call


@pytest.fixture(scope="module")
def short(run, tmp_path_factory):
    """The folder in which an experiment was run, `short`: two rows of Table 8, without images, which compiles sooner."""
    folder = tmp_path_factory.mktemp("short")
    rows = tuple(replace(row, flags={**row.flags, **SHORT}) for row in EXPERIMENTS["table8"].rows[:2])
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(EXPERIMENTS, "short", replace(EXPERIMENTS["table8"], rows=rows))
        assert run(folder, "short", "--limit", 3) == 0
        yield folder


def assert_complete(name, folder):
    results = json.loads((folder / "runs" / "toy" / f"{name}.json").read_text())
    assert [row["label"] for row in results["rows"]] == [row.label for row in EXPERIMENTS[name].rows]
    for row in results["rows"]:
        (outcome,) = row["runs"]
        assert outcome["problem"] == ""
        assert np.isfinite(outcome["metrics"]["rmse_r_deg"])
        assert outcome["metrics"]["pairs"] <= 4
    assert bool(results["baselines"]) == EXPERIMENTS[name].baselines
    for suffix in ("txt", "md", "tex", "png"):
        assert (folder / "runs" / "toy" / f"{name}.{suffix}").stat().st_size > 0


def test_a_table_runs_from_end_to_end(short):
    assert_complete("short", short)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(EXPERIMENTS))
def test_an_experiment_runs_from_end_to_end(name, run, tmp_path, capsys):
    assert run(tmp_path, name, "--limit", 4) == 0, capsys.readouterr().out
    assert_complete(name, tmp_path)


def test_recorded_pairs_and_methods_without_learning_by_a_network_that_another_table_trained(short, run, monkeypatch, capsys):
    regression, test = {**EXPERIMENTS["table8"].rows[0].flags, **SHORT}, {"data.source": "stanford-scans"} | OBSERVED
    rows = (Row("PCRNet", "paper", regression, test), Row("PCRNet, then GICP", "paper", regression, test, then="GICP"))
    monkeypatch.setitem(EXPERIMENTS, "recorded", Experiment("range scans", NOISE, rows, baselines=True))
    logs = {path: path.read_bytes() for path in short.glob("runs/toy/*/log.jsonl")}
    assert run(short, "recorded", "--limit", 4) == 0, capsys.readouterr().out
    assert_complete("recorded", short)
    assert {path: path.read_bytes() for path in short.glob("runs/toy/*/log.jsonl")} == logs


def test_what_is_finished_is_not_done_again_and_what_is_missing_is(short, run, tmp_path, capsys):
    shutil.copytree(short, tmp_path, dirs_exist_ok=True)
    folder = tmp_path / "runs" / "toy"
    logs = {path: path.read_bytes() for path in folder.glob("*/log.jsonl")}
    first = json.loads((folder / "short.json").read_text())
    lost = next(path.parent for path in logs if "pcrnet" in str(path))
    shutil.rmtree(lost)
    assert run(tmp_path, "short", "--limit", 3) == 0
    again = json.loads((folder / "short.json").read_text())
    for before, after in zip(first["rows"], again["rows"], strict=True):
        expected, found = before["runs"][0]["metrics"], after["runs"][0]["metrics"]
        timed = "PCRNet" in before["label"]
        assert {k: v for k, v in found.items() if not timed or k != "seconds_per_pair"} == {
            k: v for k, v in expected.items() if not timed or k != "seconds_per_pair"
        }
    for path, text in logs.items():
        assert path.exists()
        assert path.parent == lost or path.read_bytes() == text
    capsys.readouterr()
    assert run(tmp_path, "short", "--limit", 3, "--only-collect") == 0
    assert "not run" not in capsys.readouterr().out
    assert json.loads((folder / "short.json").read_text())["rows"] == again["rows"]


def test_damaged_results_are_named(short, run, tmp_path, capsys):
    shutil.copytree(short, tmp_path, dirs_exist_ok=True)
    for path in (tmp_path / "runs" / "toy").glob("*pcrnet*/*/results.json"):
        path.write_text("{")
    assert run(tmp_path, "short", "--limit", 3) == 1
    assert "results.json: not readable" in capsys.readouterr().out


def test_data_that_is_not_given_leaves_a_row_empty_and_a_failure_is_shown(tmp_path, objects, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    places = ["--scale", "toy", "--runs", str(tmp_path / "runs")]
    assert main(["run", "table5", "--data", str(objects), *places]) == 0
    assert "not run: no folder of sevenscenes data was given" in capsys.readouterr().out
    assert main(["run", "table8", "--data", str(tmp_path / "nothing"), *places]) == 1
    printed = capsys.readouterr().out
    assert "failed: " in printed
    assert str(tmp_path / "nothing") in printed
    assert all(word in (tmp_path / "runs" / "toy" / "table8.txt").read_text() for word in ("PCRNet", "0, 1 failed"))


def test_an_unknown_experiment_is_an_error_and_the_list_has_all(capsys):
    assert main(["run", "table9"]) == 2
    assert "table9" in capsys.readouterr().err
    assert main(["run"]) == 2
    assert "expected all, or some of table1" in capsys.readouterr().err
    assert main(["list"]) == 0
    printed = capsys.readouterr().out
    assert all(f"{name}: {experiment.about}" in printed for name, experiment in EXPERIMENTS.items())
    assert "model.matching.iterations=5" in printed


def test_a_row_that_runs_out_of_memory_does_not_stop_the_others(tmp_path, objects, monkeypatch, capsys):
    def train(*_, **__):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED")

    monkeypatch.setattr("cmig_jax.experiments.run.train", train)
    assert main(["run", "table8", "--data", str(objects), "--scale", "toy", "--runs", str(tmp_path / "runs")]) == 1
    assert capsys.readouterr().out.count("  failed: RESOURCE_EXHAUSTED") == 3
