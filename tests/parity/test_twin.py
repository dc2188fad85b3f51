"""The PyTorch twin: recorded cases where they are, draws, losses, the benchmark's calls."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cmig_jax.parity.cmignet_bench import TwinBench
from cmig_jax.parity.cmignet_check import flags_of_case
from cmig_jax.parity.cmignet_compare import run_twin
from cmig_jax.parity.cmignet_layout import UNUSED, layout, small, with_margins
from cmig_jax.parity.cmignet_twin import Twin
from cmig_jax.parity.inputs import random_inputs, random_pairs
from cmig_jax.parity.rows import compare_all
from cmig_jax.parity.weights import named_weights

from .recording import GOLDEN, read_whole

torch.set_num_threads(1)
FLAGS = small()
STATE = named_weights(layout(FLAGS), 0)


@pytest.mark.skipif(not GOLDEN.is_dir(), reason="no recorded cases here")
@pytest.mark.parametrize(("name", "margins"), [("eval_seed0", None), ("train_ocl_seed0", (6, 8))])
def test_the_twin_repeats_the_recorded_case(name, margins):
    case = read_whole(GOLDEN / f"{name}.npz")
    flags = flags_of_case(case, margins=margins)
    state = named_weights(layout(flags), 0)
    run = {f"statistics/{key}": value for key, value in state.items()} | run_twin(Twin(flags, state), case.inputs, "src_idx" in case.inputs)
    assert not [row for row in compare_all(case.outputs, run, "float64") if not row.holds]
    gradients = {key.partition("/")[2] for key in run if key.startswith("gradient/")}
    assert gradients == {key.partition("/")[2] for key in case.outputs if key.startswith("grad_norm/")}


def test_training_draws_keypoints_and_repeats_them():
    inputs = random_inputs(0, pairs=2, points=40, views=2, size=32)
    run = run_twin(Twin(FLAGS, STATE), inputs, train=True, seed=0)
    assert run["src_idx"].shape == (2, 24)
    assert all(len(np.unique(half)) == 12 for row in run["src_idx"] for half in np.split(row, 2))
    again = run_twin(Twin(FLAGS, STATE), inputs | {"src_idx": run["src_idx"].astype(np.int32)}, train=True)
    assert all(np.array_equal(run[key], again[key]) for key in run)
    assert run["loss_terms"].shape == (3 + 2 * 2,)
    assert "gradient/h3.0.weight" in run
    assert not any(key.partition("/")[2].startswith(UNUSED) for key in run)


def test_the_overlap_loss_is_an_option():
    inputs = random_inputs(0, pairs=2, points=40, views=1, size=32)
    runs = [run_twin(Twin(with_margins(FLAGS, margins), STATE), inputs, train=True) for margins in (None, (0.5, 8.0))]
    off, on = (run["loss_terms"] for run in runs)
    assert off[1] == 0
    assert on[1] > 0
    assert np.array_equal(np.delete(off, 1), np.delete(on, 1))


def test_evaluation_gives_a_rotation_and_no_losses():
    run = run_twin(Twin(FLAGS, named_weights(layout(FLAGS), 2)), random_inputs(1, pairs=3, points=40, views=2, size=40), train=False)
    np.testing.assert_allclose(run["R"] @ run["R"].transpose(0, 2, 1), np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(run["R"]), 1)
    assert not any(key.startswith(("loss", "gradient/", "statistics/")) for key in run)


def test_a_foreign_state_is_refused():
    with pytest.raises(ValueError, match=r"missing h3\.6\.bias"):
        Twin(FLAGS, {name: value for name, value in STATE.items() if name != "h3.6.bias"})


@pytest.mark.parametrize("images", [True, False])
def test_the_benchmarks_calls(images):
    source, target, R, t = random_pairs(0, 2, 40)
    views = np.random.default_rng(0).integers(0, 256, (2, 3, 32, 32)).astype(np.uint8)
    features = np.random.default_rng(0).random((2, FLAGS.points.dim), np.float32)
    bench = TwinBench(FLAGS, STATE, source, target, views if images else features, R, t, "cpu")
    assert bench.inference()().shape == (2, 3, 3)
    names = {"point_encoder", "fusion", "scores", "matching"} | ({"image_encoder"} if images else set())
    for train in (False, True):
        stages = bench.stages(train)
        assert set(stages) == names
        assert all(torch.isfinite(x).all() and x.requires_grad == train for work in stages.values() for x in work())
    step = bench.training()
    before = bench.twin.parameters["h3.0.weight"].detach().clone()
    assert np.isfinite([step(), step()]).all()
    assert not torch.equal(before, bench.twin.parameters["h3.0.weight"])
    whole = TwinBench(replace(FLAGS), STATE, source, target, views if images else features, R, t, "cpu").inference()()
    assert torch.isfinite(whole).all()
