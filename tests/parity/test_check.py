"""Cases recorded with the twin, checked with the Flax network; and the shared ones, where they are."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cmig_jax.parity.__main__ import main
from cmig_jax.parity.check import check
from cmig_jax.parity.recorded import Case, random_inputs, read_case, write_case
from cmig_jax.parity.rows import table, worst_first
from cmig_jax.parity.sizes import SMALL, Sizes
from cmig_jax.parity.twin_run import record_case

torch.set_num_threads(1)
MARGINS = (6.0, 8.0)
GOLDEN = Path(os.environ.get("CMIG_SHARED", Path(__file__).parents[3] / "shared")) / "golden"
recorded = pytest.mark.skipif(not GOLDEN.is_dir(), reason="no recorded cases here")


@pytest.fixture(scope="module")
def training_case() -> Case:
    return record_case(SMALL, random_inputs(0, pairs=2, points=64, views=2, size=32), train=True, seed=0, margins=MARGINS)


def holding(rows):
    failing = [row for row in rows if not row.holds]
    assert not failing, "\n" + table(worst_first(failing))
    return rows


def test_a_training_case_in_float64(training_case):
    rows = holding(check(training_case, margins=MARGINS, sizes=SMALL))
    assert [row.key for row in rows] == list(training_case.outputs)
    kinds = {row.key.split("/")[0]: row.bound for row in rows}
    assert kinds["grad_norm"] == kinds["buffer_sum"] == 1e-6
    assert kinds["loss_terms"] == kinds["feat_src"] == kinds["it1"] == kinds["R"] == 1e-8


def test_a_training_case_stage_by_stage_in_float32(training_case):
    rows = holding(check(training_case, dtype="float32", margins=MARGINS, sizes=SMALL))
    assert [row.key for row in rows] == list(training_case.outputs)
    assert {row.bound for row in rows} == {1e-4}
    assert max(row.relative for row in rows) > 1e-9  # it was float32


@pytest.mark.parametrize(("pairs", "points", "keypoints", "views", "size", "iterations"), [(1, 40, 13, 1, 24, 1), (3, 31, 31, 3, 40, 3)])
def test_evaluation_cases_of_other_sizes(pairs, points, keypoints, views, size, iterations, tmp_path):
    sizes = replace(SMALL, keypoints=keypoints, iterations=iterations)
    inputs = random_inputs(5, pairs, points, views, size)
    inputs = replace(inputs, views=inputs.views[..., : size - 7])  # H != W
    write_case(tmp_path / "case.npz", record_case(sizes, inputs, train=False, seed=4))
    case = read_case(tmp_path / "case.npz")
    holding(check(case, seed=4, sizes=SMALL))
    assert not all(row.holds for row in check(case, seed=5, sizes=SMALL))


def test_what_does_not_match_fails(training_case):
    outputs = dict(training_case.outputs)
    outputs["it0/logit"] = outputs["it0/logit"] + 1e-6
    outputs["R"] = np.full_like(outputs["R"], np.nan)
    outputs["grad_norm/h3.0.weight"] = outputs["grad_norm/h3.0.weight"] * (1 + 1e-5)
    outputs["t"] = outputs["t"][:1]
    outputs["it9/unknown"] = np.zeros(3)
    rows = check(Case(training_case.inputs, outputs), iterations=2, margins=MARGINS, sizes=SMALL)
    assert {row.key for row in rows if not row.holds} == {"it0/logit", "R", "grad_norm/h3.0.weight", "t", "it9/unknown"}


def test_the_command_line(tmp_path, capsys):
    case, report = tmp_path / "case.npz", tmp_path / "report.json"
    sizes = Sizes(keypoints=12, iterations=1)
    write_case(case, record_case(sizes, random_inputs(1, pairs=1, points=24, views=1, size=32), train=False, seed=3))
    assert main(["check", str(case), "--seed", "3", "--json", str(report)]) == 0
    said = capsys.readouterr().out
    written = json.loads(report.read_text())
    assert written["holds"]
    assert all(row["key"] in said for row in written["rows"])
    assert main(["check", str(case), "--seed", "4", "--json", str(report)]) == 1
    assert "FAILS" in capsys.readouterr().out
    assert not json.loads(report.read_text())["holds"]
    case.write_bytes(case.read_bytes()[:500])
    assert main(["check", str(case)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@recorded
@pytest.mark.parametrize(("name", "margins"), [("eval_seed0", None), ("train_seed0", None), ("train_ocl_seed0", MARGINS)])
def test_the_shared_cases_in_float64(name, margins):
    holding(check(read_case(GOLDEN / f"{name}.npz"), margins=margins))


@recorded
def test_a_shared_case_stage_by_stage_in_float32():
    holding(check(read_case(GOLDEN / "eval_seed0.npz"), dtype="float32"))
