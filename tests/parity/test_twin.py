"""The PyTorch twin: names and shapes, recorded cases (where present), modes, draws."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from cmig_jax.parity.recorded import named_weights, random_inputs, read_case, recorded_form
from cmig_jax.parity.sizes import SMALL, Sizes
from cmig_jax.parity.twin import Twin
from cmig_jax.parity.twin_run import make_twin, record_case, run_twin, state_shapes

torch.set_num_threads(1)
GOLDEN = Path(os.environ.get("CMIG_SHARED", Path(__file__).parents[3] / "shared")) / "golden"
recorded = pytest.mark.skipif(not GOLDEN.is_dir(), reason="no recorded cases here")


def test_state_has_the_released_size():
    shapes = state_shapes(Sizes())
    trainable = ("running_mean", "running_var", "num_batches_tracked")
    assert sum(int(np.prod(shape)) for name, shape in shapes.items() if not name.endswith(trainable)) == 18_106_876


@recorded
def test_state_is_the_released_one():
    recorded_shapes = {name: tuple(shape) for name, shape in json.loads((GOLDEN / "state_dict_shapes.json").read_text()).items()}
    assert list(state_shapes(Sizes()).items()) == list(recorded_shapes.items())


@recorded
@pytest.mark.parametrize(("name", "margins"), [("eval_seed0", None), ("train_ocl_seed0", (6, 8))])
def test_twin_repeats_the_recorded_case(name, margins):
    case = read_case(GOLDEN / f"{name}.npz")
    sizes = Sizes(keypoints=case.keypoints, iterations=case.iterations)
    twin = make_twin(sizes, named_weights(state_shapes(sizes), 0), margins=margins)
    run = run_twin(twin, case.inputs, case.training)
    for key, expected in case.outputs.items():
        if key.startswith("grad_norm/"):
            np.testing.assert_allclose(
                np.linalg.norm(run.gradients[key.removeprefix("grad_norm/")]), expected, rtol=1e-6, atol=1e-12, err_msg=key
            )
        elif key.startswith("buffer_sum/"):
            np.testing.assert_allclose(run.buffers[key.removeprefix("buffer_sum/")].sum(), expected, rtol=1e-6, err_msg=key)
        else:
            value = recorded_form(key, run.outputs)
            assert value is not None, key
            assert np.abs(value - expected).max() <= 1e-8 * np.abs(expected).max(), key
    assert {key.removeprefix("grad_norm/") for key in case.outputs if key.startswith("grad_norm/")} == set(run.gradients)


def test_training_draws_keypoints_and_repeats_them():
    inputs = random_inputs(0, pairs=2, points=40, views=2, size=32)
    case = record_case(SMALL, inputs, train=True, seed=0)
    assert case.inputs.src_idx is not None
    assert case.inputs.src_idx.shape == (2, 24)
    assert all(len(np.unique(half)) == 12 for row in case.inputs.src_idx for half in np.split(row, 2))
    again = record_case(SMALL, case.inputs, train=True, seed=0)
    assert all(np.array_equal(case.outputs[key], again.outputs[key]) for key in case.outputs)
    assert case.outputs["loss_terms"].shape == (3 + 2 * 2,)
    assert "grad_norm/h3.0.weight" in case.outputs
    assert not any("significance_fc" in key or "MVCNN.fc" in key for key in case.outputs if key.startswith("grad_norm/"))


def test_overlap_loss_is_an_option():
    inputs = random_inputs(0, pairs=2, points=40, views=1, size=32)
    off, on = (record_case(SMALL, inputs, train=True, seed=0, margins=m).outputs["loss_terms"] for m in (None, (0.5, 8.0)))
    assert off[1] == 0
    assert on[1] > 0
    assert np.array_equal(np.delete(off, 1), np.delete(on, 1))


def test_evaluation_gives_a_rotation_and_no_losses():
    case = record_case(SMALL, random_inputs(1, pairs=3, points=40, views=2, size=40), train=False, seed=2)
    R = case.outputs["R"]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    assert not case.training
    assert "loss" not in case.outputs


def test_training_needs_the_true_pose():
    twin = Twin(SMALL).train()
    with pytest.raises(ValueError, match="true pose"):
        twin(torch.rand(2, 3, 20), torch.rand(2, 3, 20), torch.rand(2, 1, 3, 32, 32))


def test_a_foreign_state_is_refused():
    state = named_weights(state_shapes(SMALL), 0)
    state.pop("h3.6.bias")
    with pytest.raises(RuntimeError, match=r"h3\.6\.bias"):
        make_twin(SMALL, state)
