"""Each network held to recorded cases of its official implementation: cut-down ones here, whole ones where they are."""

from pathlib import Path

import numpy as np
import pytest

from cmig_jax.parity.cases import read_cases
from cmig_jax.parity.convert import layout_of
from cmig_jax.parity.method import check_method, is_training, weights_of
from cmig_jax.parity.methods import METHODS
from cmig_jax.parity.rows import table, used
from cmig_jax.parity.weights import to_flax, to_torch

from ..recording import GOLDEN
from .cutting import cut

RECORDED = Path(__file__).parent / "recorded"
CASES = sorted(path.stem for path in RECORDED.glob("*.npz"))
SHARED = GOLDEN.parent
PUBLIC = {"dcp_v1": "dcp_v1.t7", "pointnetlk_revisited": "pointnetlk_revisited.pth"}
shared = pytest.mark.skipif(not GOLDEN.is_dir(), reason="no recorded cases here")


def read(path, method):
    (case,) = read_cases(path, method.inputs, method.optional)
    return case


def assert_holds(rows):
    failing = [row for row in rows if not row.holds]
    assert not failing, "\n" + table(sorted(failing, key=used, reverse=True))


def test_every_method_has_a_case_in_each_mode():
    modes = {(stem.split("-")[0], is_training(read(RECORDED / f"{stem}.npz", METHODS[stem.split("-")[0]]))) for stem in CASES}
    assert modes == {(name, train) for name in METHODS for train in (False, True)}


@pytest.mark.parametrize("stem", CASES)
def test_a_network_computes_what_was_recorded(stem):
    method = METHODS[stem.split("-")[0]]
    case = read(RECORDED / f"{stem}.npz", method)
    rows = check_method(method, case, weights_of(method, case))
    assert {row.key for row in rows} == set(case.outputs)
    assert_holds(rows)


@shared
@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(GOLDEN.glob("*/*.npz")), ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_whole_cases(path):
    method = METHODS[path.parent.name]
    case = read(path, method)
    if not path.stem.startswith("public"):
        assert_holds(check_method(method, case, weights_of(method, case)))


@shared
@pytest.mark.parametrize("name", PUBLIC)
def test_public_weights(name):
    torch_files = pytest.importorskip("cmig_jax.parity.torch_files")
    method = METHODS[name]
    case = read(GOLDEN / name / "public_weights_eval.npz", method)
    assert_holds(check_method(method, case, torch_files.read_torch(SHARED / "weights" / PUBLIC[name])))


@shared
@pytest.mark.parametrize("stem", CASES)
def test_a_case_is_cut_from_the_whole_one(stem):
    name, _, mode = stem.partition("-")
    whole, ours = read(GOLDEN / name / f"{mode}.npz", METHODS[name]), read(RECORDED / f"{stem}.npz", METHODS[name])
    again = cut(METHODS[name], whole)
    assert list(again) == list(ours.outputs)
    assert all(np.array_equal(value, ours.outputs[key]) for key, value in again.items())
    assert all(np.array_equal(value, ours.inputs[key]) for key, value in whole.inputs.items())


@pytest.mark.parametrize("name", METHODS)
def test_weights_go_both_ways_without_loss(name):
    method = METHODS[name]
    stem = next(stem for stem in CASES if stem.startswith(f"{name}-"))
    case = read(RECORDED / f"{stem}.npz", method)
    flags, state = method.flags_of_case(case), weights_of(method, case)
    variables, beside = to_flax(state, layout_of(flags))
    again, filled = to_torch(variables, layout_of(flags), beside)
    assert not filled
    assert list(again) == [tensor.name for tensor in method.layout(flags)]
    assert all(np.array_equal(again[key], value) for key, value in state.items())
    assert method.flags_of_state(state).network == method.network


def test_a_wrong_weight_fails():
    method = METHODS["pcrnet_iterative"]
    case = read(RECORDED / "pcrnet_iterative-eval_seed0.npz", method)
    state = weights_of(method, case)
    rows = check_method(method, case, {**state, "linear.8.bias": state["linear.8.bias"] + 1e-3})
    assert not all(row.holds for row in rows)


def test_the_command(main, tmp_path):
    path = RECORDED / "masknet-eval_seed0.npz"
    done = main("parity", "check", path, "--method", "masknet", "--json", tmp_path / "rows.json")
    assert done.returncode == 0, done.stdout + done.stderr
    for arguments, expected in (
        ((path, "--method", "masknets"), "expected cmignet, or one of dcp_v1"),
        (("--method", "masknet"), "expected a recorded case"),
        ((path, "--method", "masknet", "--dtype", "float32"), "expected float64"),
        ((path, "--method", "rpmnet"), "it has no points_src"),
    ):
        done = main("parity", "check", *arguments)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert expected in done.stderr
