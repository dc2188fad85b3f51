"""The recorded case that comes with the package: what the released network computed, in training and in evaluation mode."""

import json
import os

import numpy as np
import pytest

from cmig_jax.commands.parity import RELEASED
from cmig_jax.parity.cases import Case, read_cases
from cmig_jax.parity.cmignet_run import INPUTS, TRAINING_INPUTS

from .recording import GOLDEN, read_whole, write_case, write_released


@pytest.mark.parametrize("kernels", [pytest.param("plain", marks=pytest.mark.slow), "fast"])
def test_the_network_computes_the_same(main, tmp_path, kernels):
    done = main("parity", "check", "--kernels", kernels, "--json", tmp_path / "rows.json")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = {row["key"]: row for row in json.loads((tmp_path / "rows.json").read_text())["rows"]}
    assert all(key in done.stdout for key in rows)
    assert not any(row["tie"] for row in rows.values())
    assert sum(key.startswith("grad_norm/") for key in rows) == 243
    assert sum(key.startswith("buffer_sum/") for key in rows) == 118
    assert {"loss", "loss_terms", "R", "t", "it2/logit/stats", "evaluation/R", "evaluation/it2/match_F/stats"} <= set(rows)


def test_what_differs_fails_and_what_is_no_case_is_said_in_one_line(main, tmp_path):
    training = read_cases(RELEASED, INPUTS, TRAINING_INPUTS)[0]
    inputs = {name: value for name, value in training.inputs.items() if name not in TRAINING_INPUTS}
    case, report = tmp_path / "case.npz", tmp_path / "rows.json"
    write_case(case, Case(inputs, {"it0/kept": np.zeros((2, 256)), "R": np.zeros((2, 3, 3))}))
    done = main("parity", "check", case, "--seed", 3, "--kernels", "plain", "--json", report)
    assert done.returncode == 1
    assert "FAILS" in done.stdout
    written = json.loads(report.read_text())
    assert (written["holds"], written["seed"], written["case"]) == (False, 3, str(case))
    case.write_bytes(case.read_bytes()[:500])
    done = main("parity", "check", case)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_it_is_small_and_holds_both_modes():
    assert os.path.getsize(RELEASED) <= 300_000
    training, evaluation = read_cases(RELEASED, INPUTS, TRAINING_INPUTS)
    assert training.inputs["src_idx"].shape == (2, 256)
    assert "src_idx" not in evaluation.inputs
    assert {"R", "t", "score_a/stats", "tgt_chosen", "it2/chosen", "it2/kept"} <= set(evaluation.outputs)


@pytest.mark.skipif(not GOLDEN.is_dir(), reason="no recorded cases here")
def test_it_is_cut_from_the_whole_cases(tmp_path):
    write_released(tmp_path / "released.npz", *(read_whole(GOLDEN / f"{name}_seed0.npz") for name in ("train", "eval")))
    for ours, again in zip(*(read_cases(path, INPUTS, TRAINING_INPUTS) for path in (RELEASED, tmp_path / "released.npz")), strict=True):
        assert all(np.array_equal(ours.inputs[name], value) for name, value in again.inputs.items())
        assert list(ours.outputs) == list(again.outputs)
        assert all(np.array_equal(ours.outputs[name], value) for name, value in again.outputs.items())
