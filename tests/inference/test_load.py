"""Loading a network: a run folder, a weights file or the package; what does not fit is named."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from cmig_jax.devices import device_mesh
from cmig_jax.inference.load import load
from cmig_jax.training.checkpoint import Checkpoints, write_config
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import build, create_state


@pytest.fixture(scope="module")
def state(tiny):
    return create_state(build(tiny), optimizer(tiny.optim, 1), tiny, device_mesh(1, 1))


@pytest.fixture
def run(tiny, state, tmp_path):
    """A run folder with a checkpoint of step 3."""
    write_config(tmp_path, tiny)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(3, state.replace(step=state.step + 3), {}, None)
    checkpoints.close()
    return tmp_path


def test_a_run_is_loaded_as_it_was_saved(tiny, state, run):
    network = load(run)
    assert (network.config, network.step, network.title) == (tiny, 3, "CMIGNet")
    jax.tree.map(np.testing.assert_array_equal, network.variables, state.variables)


def test_no_pairs_have_no_poses(run):
    poses = load(run)([])
    assert (poses.R.shape, poses.t.shape) == ((0, 3, 3), (0, 3))


def test_flags_may_change_what_the_weights_do_not_depend_on(tiny, run):
    keypoints = dataclasses.replace(tiny.model.keypoints, test_count=36)
    config = dataclasses.replace(tiny, model=dataclasses.replace(tiny.model, keypoints=keypoints))
    assert load(run, config=config).config == config


def test_flags_that_do_not_fit_the_weights_are_named(tiny, run):
    longer = dataclasses.replace(tiny.model, matching=dataclasses.replace(tiny.model.matching, iterations=4))
    with pytest.raises(ValueError, match=r"trained before model\.matching\.iterations: \d -> 4"):
        load(run, config=dataclasses.replace(tiny, model=longer))


@pytest.mark.parametrize("asked", [{"batch": 0}, {"which": "worst"}])
def test_a_batch_or_checkpoint_that_is_none_is_refused(asked):
    with pytest.raises(ValueError, match=f"{next(iter(asked))} = .*expected at least 1, and best or last"):
        load(**asked)


def test_a_run_folder_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path}/nowhere: expected a run folder"):
        load(tmp_path / "nowhere")


def test_a_run_folder_without_a_checkpoint_is_named(tiny, tmp_path):
    write_config(tmp_path, tiny)
    with pytest.raises(ValueError, match=f"{tmp_path}/checkpoints: expected checkpoints"):
        load(tmp_path)


@pytest.mark.parametrize("damage", ["", "{", "[1]", "other version", "other value", "other network"])
def test_a_run_folder_with_a_damaged_config_is_named(tiny, tmp_path, damage):
    write_config(tmp_path, tiny)
    path = tmp_path / "config.json"
    values = json.loads(path.read_text())
    if damage == "other version":
        values["optim"]["rate"] = 1
    if damage == "other value":
        values["views"]["of"] = "everything"
    if damage == "other network":
        values["network"] = "pointnet"
    path.write_text(json.dumps(values) if damage.startswith("other") else damage)
    with pytest.raises(ValueError, match=f"{path}: "):
        load(tmp_path)
