"""The table of an experiment: mean and spread, quoted figures apart, empty rows empty."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from cmig_jax.experiments.figure import plot_rows
from cmig_jax.experiments.plan import plan
from cmig_jax.experiments.run import Outcome, Results
from cmig_jax.experiments.table import as_json, notes, spread, table
from cmig_jax.report.plots import save
from configs.catalogue import catalogue
from configs.experiments import EXPERIMENTS

TABLE7 = EXPERIMENTS["table7"]


def metrics(rmse):
    names = ("mae_r_deg", "rmse_t", "mae_t", "recall")
    return {"rmse_r_deg": rmse, **dict.fromkeys(names, 0.5), "seconds_per_pair": 0.01, "pairs": 4}


@pytest.fixture
def results():
    jobs = plan(TABLE7, catalogue(), scale="cpu", roots={}, source="shapes", seeds=(0, 1), runs=Path("runs"))
    found = [Outcome(job, problem="failed: no such file") for job in jobs]
    found[0], found[1] = Outcome(jobs[0], metrics(1.0)), Outcome(jobs[1], metrics(3.0))
    found[2], found[3] = Outcome(jobs[2], metrics(7.25)), Outcome(jobs[3], problem="not run")
    return Results(tuple(found), {"identity": metrics(26.0)})


def cells(text):
    return {line.split("|")[1].strip(): [cell.strip() for cell in line.split("|")[2:-1]] for line in text.splitlines()}


def test_mean_and_spread_over_seeds_and_quoted_figures_in_their_own_columns(results):
    rows = cells(table(TABLE7, results, "markdown"))
    assert rows["n = 2"][:2] == ["2", "2.00 ± 1.41"]
    assert rows["n = 3"][:2] == ["1", "7.25"]
    assert rows["n = 3"][-4:] == ["1.472", "0.632", "0.0058", "0.0036"]
    assert rows["identity"][1] == "26.00"
    assert set(rows["identity"][-4:]) == {"–"}
    headings = rows[""]
    assert headings.index("quoted RMSE(R)") > headings.index("RMSE(R) [deg]")


def test_a_row_that_failed_is_shown_so_and_has_no_figures(results):
    rows = cells(table(TABLE7, results, "markdown"))
    assert rows["n = 4"][0] == "0, 2 failed"
    assert set(rows["n = 4"][1:-4]) == {"–"}
    assert notes(TABLE7, results)[:2] == ["n = 3, seed 1: not run", "n = 4, seed 0: failed: no such file"]


def test_every_style_has_every_row(results):
    for style in ("text", "markdown", "latex"):
        text = table(TABLE7, results, style)
        assert all(row.label in text for row in TABLE7.rows), style
    latex = table(TABLE7, results, "latex")
    assert r"2.00 $\pm$ 1.41" in latex
    assert len({line.count("&") for line in latex.splitlines() if "&" in line}) == 1


def test_json_has_the_commands_and_marks_what_is_quoted(results):
    found = json.loads(json.dumps(as_json("table7", TABLE7, results)))
    row = found["rows"][0]
    assert row["runs"][1]["metrics"]["rmse_r_deg"] == 3.0
    assert row["runs"][0]["commands"][0].startswith("python train.py paper-cpu ")
    assert "--model.matching.iterations 2" in row["runs"][0]["commands"][0]
    assert row["quoted_from_the_paper"]["rmse_r_deg"] == 1.972
    assert found["rows"][2]["runs"][0] == {**found["rows"][2]["runs"][0], "metrics": None, "problem": "failed: no such file"}


def test_the_spread_of_one_value_is_zero():
    assert spread([4.0]) == (4.0, 0.0)
    assert spread([1.0, 3.0]) == (2.0, pytest.approx(2**0.5))


def test_the_figure_shows_the_metrics_that_the_experiment_names(results, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("cmig_jax.experiments.figure.save", lambda figure, path: (drawn.append(figure), save(figure, path)))
    for experiment in (TABLE7, replace(TABLE7, drawn=("recall", "mae_t"))):
        plot_rows("table7", experiment, results, tmp_path / "table7.png")
    assert (tmp_path / "table7.png").stat().st_size > 5000
    assert [[axes.get_xlabel() for axes in figure.axes] for figure in drawn] == [
        ["RMSE(R), deg", "MAE(R), deg"],
        ["recall, %", "MAE(t), units"],
    ]
    dots = [[line.get_xdata().tolist() for line in figure.axes[0].lines] for figure in drawn]
    assert dots == [[[1, 3], [7.25]], [[50, 50], [50]]]


def test_every_experiment_draws_metrics_of_its_table():
    assert all(set(experiment.drawn) <= set(experiment.columns) for experiment in EXPERIMENTS.values())
