"""CMIGNet held to cases that are recorded with the twin, and to the whole recorded ones where they are."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from cmig_jax.commands import parity
from cmig_jax.parity.cases import Case
from cmig_jax.parity.cmignet_check import check, flags_of_case
from cmig_jax.parity.cmignet_layout import layout, small, with_margins
from cmig_jax.parity.inputs import random_inputs
from cmig_jax.parity.rows import table, used
from cmig_jax.parity.weights import named_weights

from .recording import GOLDEN, read_whole, record, write_case

torch.set_num_threads(1)
MARGINS = (6.0, 8.0)
FLAGS = with_margins(replace(small(), matching=replace(small().matching, iterations=1)), MARGINS)
recorded = pytest.mark.skipif(not GOLDEN.is_dir(), reason="no recorded cases here")


def checked(case, flags=FLAGS, seed=0, dtype="float64", kernels="plain"):
    """Check with the weights of a seed; `test_compare` and `test_released` take both kinds of kernels."""
    return check(case, flags, named_weights(layout(flags), seed), dtype, kernels)


@pytest.fixture(scope="module")
def training_case() -> Case:
    return record(FLAGS, random_inputs(1, pairs=2, points=64, views=2, size=32), train=True, seed=0)  # shapes as in test_compare


def holding(rows):
    failing = [row for row in rows if not row.holds]
    assert not failing, "\n" + table(sorted(failing, key=used, reverse=True))
    return rows


def test_a_training_case_in_float64(training_case):
    rows = holding(checked(training_case))
    assert [row.key for row in rows] == list(training_case.outputs)
    assert not any(row.tie for row in rows)
    kinds = {row.key.split("/")[0]: row.bound for row in rows}
    assert kinds["grad_norm"] == kinds["buffer_sum"] == 1e-6
    assert kinds["loss_terms"] == kinds["feat_src"] == kinds["it0"] == kinds["R"] == 1e-8


@pytest.mark.slow
def test_a_training_case_stage_by_stage_in_float32(training_case):
    rows = holding(checked(training_case, dtype="float32"))
    assert [row.key for row in rows] == list(training_case.outputs)


def test_an_evaluation_case_stage_by_stage_in_float32():
    case = record(FLAGS, random_inputs(1, pairs=2, points=64, views=2, size=32), train=False, seed=0)
    rows = holding(checked(case, dtype="float32"))
    assert {row.bound for row in rows} == {1e-4}
    assert max(row.relative for row in rows) > 1e-9  # it was float32


@pytest.mark.parametrize(("pairs", "points", "keypoints", "views", "size", "iterations"), [(1, 40, 13, 1, 24, 1), (3, 31, 31, 3, 40, 3)])
def test_evaluation_cases_of_other_sizes(pairs, points, keypoints, views, size, iterations, tmp_path):
    flags = replace(
        small(), keypoints=replace(small().keypoints, count=keypoints), matching=replace(small().matching, iterations=iterations)
    )
    inputs = random_inputs(5, pairs, points, views, size)
    inputs["views"] = inputs["views"][..., : size - 7]  # H != W
    write_case(tmp_path / "case.npz", record(flags, inputs, train=False, seed=4))
    case = read_whole(tmp_path / "case.npz")
    found = flags_of_case(case)
    assert (found.keypoints, found.matching.iterations) == (flags.keypoints, flags.matching.iterations)
    holding(checked(case, flags, seed=4))
    assert not all(row.holds for row in checked(case, flags, seed=5))


def test_what_does_not_match_fails(training_case):
    outputs = dict(training_case.outputs)
    outputs["it0/logit"] = outputs["it0/logit"] + 1e-6
    outputs["R"] = np.full_like(outputs["R"], np.nan)
    outputs["grad_norm/h3.0.weight"] = outputs["grad_norm/h3.0.weight"] * (1 + 1e-5)
    outputs["t"] = outputs["t"][:1]
    outputs["it9/unknown"] = np.zeros(3)
    outputs["feat_tgt/stats"] = outputs["feat_tgt/stats"] * [1, 1, 1, 1 + 1e-7]
    rows = checked(replace(training_case, outputs=outputs))
    changed = {"it0/logit", "R", "grad_norm/h3.0.weight", "t", "it9/unknown", "feat_tgt/stats"}
    assert {row.key for row in rows if not row.holds} == changed


def test_a_case_of_another_network_is_refused():
    with pytest.raises(ValueError, match="its outputs have no it0/logit"):
        flags_of_case(Case({}, {"R": np.zeros((2, 3, 3))}))


def test_no_pytorch_is_needed():
    modules = ["cases", "rows", "weights", "inputs", "cmignet_layout", "cmignet_run", "cmignet_check", "cmignet_ties"]
    imports = "; ".join(f"import cmig_jax.parity.{name}" for name in modules)
    program = f"import sys; sys.modules['torch'] = sys.modules['safetensors'] = None; {imports}; import cmig_jax.commands.parity"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=300)


def test_pytorch_that_is_missing_is_said(tmp_path, monkeypatch):
    for module in ("cmig_jax.parity.convert", "cmig_jax.parity.torch_files"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    for module in ("torch", "safetensors", "safetensors.torch"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ValueError, match=r"is not installed: pip install 'cmig_jax\[parity\]'"):
        parity.run(parity.Convert(tmp_path / "a.pt", tmp_path / "run"))


@recorded
@pytest.mark.parametrize("kernels", ["plain", "fast"])
@pytest.mark.parametrize(("name", "margins"), [("eval_seed0", None), ("train_seed0", None), ("train_ocl_seed0", MARGINS)])
def test_the_whole_recorded_cases_in_float64(name, margins, kernels):
    case = read_whole(GOLDEN / f"{name}.npz")
    flags = flags_of_case(case, margins=margins)
    holding(checked(case, flags, kernels=kernels))


@recorded
def test_a_whole_recorded_case_stage_by_stage_in_float32():
    case = read_whole(GOLDEN / "eval_seed0.npz")
    holding(checked(case, flags_of_case(case), dtype="float32"))
