"""Run folders: what is saved comes back, what does not fit is refused by name."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.config_json import differences
from cmig_jax.devices import device_mesh, replicated
from cmig_jax.inference.run_folder import is_validated, load_variables, read_config, validation_error
from cmig_jax.training.checkpoint import Checkpoints, write_config
from cmig_jax.training.state import TrainState
from configs.modelnet40 import paper

POSITION = {"next_index": 12, "shards": [1, 2]}


def make_state(value, devices=1, width=3):
    """A state of a network that is one layer."""
    sharding = replicated(device_mesh(8, devices))
    state = TrainState(
        step=jnp.asarray(value, jnp.int32),
        params={"layer": {"kernel": jnp.full((width, 2), value, jnp.float32), "bias": jnp.arange(2.0)}},
        batch_stats={"norm": {"mean": jnp.full(2, -1.0 * value)}},
        opt_state=({"mu": jnp.full(2, 0.5)},),
    )
    return jax.tree.map(lambda x: jax.device_put(x, sharding), state)


def abstract(devices=1, width=3):
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding), make_state(0, devices, width))


def measured(error):
    return None if error is None else {"val_iso_r_deg_mean": error, "val_iso_t_mean": 0.1}


def save(run, measures, devices=1):
    """Save states of steps 10, 20, ... with these mean angles on validation (None: not validated)."""
    checkpoints = Checkpoints(run)
    for i, error in enumerate(measures, start=1):
        checkpoints.save(10 * i, make_state(10 * i, devices), POSITION, measured(error))
    checkpoints.close()


def assert_is(state, step):
    assert int(state.step) == step
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(np.array(a), np.array(b)), state, make_state(step))


def load(run, which="best", like=None):
    """Load the variables, and check that they are those of the step that is returned with them."""
    step, variables = load_variables(run, abstract().variables if like is None else like, which)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(np.array(a), np.array(b)), variables, make_state(step).variables)
    return step


def test_what_is_saved_comes_back_with_the_position_of_the_pipeline(tmp_path):
    save(tmp_path, [3.0])
    checkpoints = Checkpoints(tmp_path)
    restored = checkpoints.restore_last(abstract())
    checkpoints.close()
    assert restored is not None
    assert_is(restored[0], 10)
    assert restored[1] == POSITION


def test_an_empty_run_has_nothing_to_restore(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.restore_last(abstract()) is None
    checkpoints.close()


def test_the_best_on_validation_and_the_last_are_kept(tmp_path):
    save(tmp_path, [5.0, 2.0, 4.0, 3.0, None])
    kept = sorted(int(path.name) for path in (tmp_path / "checkpoints").iterdir() if path.is_dir())
    assert kept == [20, 50]
    assert load(tmp_path) == 20
    assert load(tmp_path, "last") == 50


def test_the_best_has_the_smallest_motion_to_the_true_pose_not_the_smallest_angle_alone():
    turned = {"val_rmse_r_deg": 7.2, "val_iso_r_deg_mean": 10.1, "val_iso_t_mean": 0.046}
    shifted = {"val_rmse_r_deg": 6.9, "val_iso_r_deg_mean": 9.8, "val_iso_t_mean": 0.065}
    assert validation_error(turned) < validation_error(shifted)
    assert validation_error(turned) == pytest.approx(np.deg2rad(10.1) + 0.046)
    assert validation_error(None) == validation_error({"val_rmse_r_deg": 1.0}) == np.inf


def test_a_run_that_was_never_validated_has_its_last_state(tmp_path):
    save(tmp_path, [None, None])
    assert load(tmp_path, "best") == 20
    assert not is_validated(tmp_path)
    save(tmp_path / "another", [1.0, None])
    assert is_validated(tmp_path / "another")


def test_a_step_is_saved_once(tmp_path):
    save(tmp_path, [3.0])
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(10, make_state(10), POSITION)
    checkpoints.close()
    assert load(tmp_path) == 10


def test_a_state_of_eight_devices_restores_on_one(tmp_path):
    save(tmp_path, [1.0], devices=8)
    checkpoints = Checkpoints(tmp_path)
    state, _ = checkpoints.restore_last(abstract(devices=1))
    checkpoints.close()
    assert_is(state, 10)
    assert {len(leaf.sharding.device_set) for leaf in jax.tree.leaves(state)} == {1}
    assert load(tmp_path) == 10


def test_no_checkpoints_folder_is_named(tmp_path):
    with pytest.raises(ValueError, match=f"{tmp_path}/checkpoints: expected checkpoints, found no such folder"):
        load(tmp_path)


def test_a_folder_without_a_checkpoint_is_named(tmp_path):
    save(tmp_path, [])
    with pytest.raises(ValueError, match=f"{tmp_path}/checkpoints: expected a checkpoint, found none"):
        load(tmp_path)


def test_a_checkpoint_of_another_network_is_refused(tmp_path):
    save(tmp_path, [1.0])
    with pytest.raises(ValueError, match=r"checkpoints, step 10: expected a whole checkpoint of the network in config\.json"):
        load(tmp_path, like=abstract(width=4).variables)
    other = {**abstract().variables, "params": {"another": abstract().params["layer"]}}
    with pytest.raises(ValueError, match="step 10: expected a whole checkpoint of the network"):
        load(tmp_path, like=other)


def damage_removed_arrays(step):
    shutil.rmtree(next(path for path in step.rglob("d") if path.is_dir()))


def damage_truncated(step):
    for path in step.rglob("*"):
        if path.is_file() and path.parent.name == "d":
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def damage_emptied_metadata(step):
    for path in step.rglob("_METADATA"):
        path.write_text("")


def test_a_folder_of_emptied_files_is_named(tmp_path):
    save(tmp_path, [1.0])
    for path in (tmp_path / "checkpoints").rglob("*"):
        if path.is_file():
            path.write_text("")
    with pytest.raises(ValueError, match=f"{tmp_path}/checkpoints.*: expected a whole checkpoint of the network"):
        load(tmp_path)


@pytest.mark.parametrize("damage", [damage_removed_arrays, damage_truncated, damage_emptied_metadata])
def test_a_damaged_checkpoint_is_refused(tmp_path, damage):
    save(tmp_path, [1.0])
    damage(tmp_path / "checkpoints" / "10")
    message = "checkpoints, step 10: expected a whole checkpoint of the network"
    with pytest.raises(ValueError, match=message) as refused:
        load(tmp_path)
    assert len(str(refused.value)) < 600
    assert "\n" not in str(refused.value)
    checkpoints = Checkpoints(tmp_path)
    with pytest.raises(ValueError, match=message):
        checkpoints.restore_last(abstract())
    checkpoints.close()


def test_a_run_folder_keeps_its_config(tmp_path):
    run, config = tmp_path / "runs" / "one", dataclasses.replace(paper(), name="one", seed=3)
    write_config(run, config)
    assert read_config(run) == config
    write_config(run, config)
    assert [path.name for path in run.iterdir()] == ["config.json"]


def test_another_config_is_refused_by_the_flags_that_differ(tmp_path):
    write_config(tmp_path, paper())
    changed = dataclasses.replace(paper(), seed=5, data=dataclasses.replace(paper().data, noise_std=0.0))
    with pytest.raises(ValueError, match=r"config\.json has another config \(seed: 0 -> 5; data\.noise_std: 0\.01 -> 0\.0\)"):
        write_config(tmp_path, changed)
    assert read_config(tmp_path) == paper()
    assert differences(paper(), paper()) == []


def test_where_things_are_may_change_where_a_run_continues(tmp_path):
    write_config(tmp_path, paper())
    moved = dataclasses.replace(paper(), name="renamed", data=dataclasses.replace(paper().data, root="elsewhere"))
    write_config(tmp_path, moved)
    assert read_config(tmp_path) == moved


@pytest.mark.parametrize("text", ["", "{", '{"nam": "x"}', "[]"])
def test_a_damaged_config_is_named(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match=f"{tmp_path}/config.json"):
        read_config(tmp_path)
