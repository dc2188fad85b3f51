"""Runs: to their end, interrupted, killed, with bad numbers; a continued run equals an uninterrupted one, bit for bit."""

import dataclasses
import json
import signal

import jax
import numpy as np
import pytest

from cmig_jax.data.shards import Shards
from cmig_jax.devices import device_mesh
from cmig_jax.inference.run_folder import read_config
from cmig_jax.training import loop
from cmig_jax.training.checkpoint import Checkpoints, write_config
from cmig_jax.training.loop import Interrupted, NonFiniteLoss, train, training_data
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import abstract_state, build

pytestmark = pytest.mark.usefixtures("compiled_once")
TOTAL = 8  # four epochs of two steps


class Killed(BaseException):
    """Stands for a process that is killed."""


@pytest.fixture(scope="module")
def uninterrupted(tiny, compiled_once, tmp_path_factory):
    run = tmp_path_factory.mktemp("uninterrupted")
    train(tiny, run, progress=False, devices=1)
    return run


@pytest.fixture
def at_batch(monkeypatch):
    """Do something when the n-th batch of the next run is asked for; what it returns replaces the batch."""

    def patch(number, act):
        class Watched:
            def __init__(self, batches):
                self.batches, self.count = batches, 0

            def __next__(self):
                self.count += 1
                batch = next(self.batches)
                return (act(batch) or batch) if self.count == number else batch

            def __getattr__(self, name):
                return getattr(self.batches, name)

        make = loop.training_batches
        monkeypatch.setattr(loop, "training_batches", lambda *args, **options: Watched(make(*args, **options)))

    yield patch
    monkeypatch.undo()


def interrupt(batch):
    signal.raise_signal(signal.SIGINT)


def kill(batch):
    raise Killed


def last_state(config, run):
    checkpoints = Checkpoints(run)
    restored = checkpoints.restore_last(abstract_state(build(config), optimizer(config.optim, 4), config, device_mesh(1, 1)))
    checkpoints.close()
    assert restored is not None
    return jax.tree.map(np.array, restored[0])


def lines(run):
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


def assert_same_end(config, run, other):
    jax.tree.map(np.testing.assert_array_equal, last_state(config, run), last_state(config, other))
    # Neither lost nor twice: a line for each step, and one for each validation.
    unclocked = [[{k: v for k, v in line.items() if k != "pairs_per_second"} for line in lines(r)] for r in (run, other)]
    assert unclocked[0] == unclocked[1]


def test_a_run_writes_its_config_log_curves_and_checkpoints(tiny, uninterrupted):
    assert read_config(uninterrupted) == tiny
    found = lines(uninterrupted)
    assert [line["step"] for line in found if "loss" in line] == list(range(1, TOTAL + 1))
    assert [line["step"] for line in found if "val_rmse_r_deg" in line] == [4, 8]
    assert {"overlap", "cross_modal", "mask", "gradient_norm", "epoch", "learning_rate", "pairs_per_second"} <= set(found[0])
    assert found[3]["epoch"] == 2
    np.testing.assert_allclose([line["learning_rate"] for line in found if "loss" in line], [1e-3] * 4 + [5e-4] * 4, rtol=1e-6)
    assert any(path.stat().st_size > 500 for path in (uninterrupted / "tensorboard").iterdir())
    assert last_state(tiny, uninterrupted).step == TOTAL
    assert not list(uninterrupted.glob("not-finite*"))


@pytest.mark.parametrize("number", [1, 4, 6])
def test_an_interrupted_run_continues_bit_for_bit(tiny, uninterrupted, tmp_path, at_batch, monkeypatch, number):
    handler = signal.getsignal(signal.SIGINT)
    at_batch(number, interrupt)
    with pytest.raises(Interrupted, match=f"stopped at step {number} of {TOTAL}; continue with --resume"):
        train(tiny, tmp_path, progress=False, devices=1)
    assert signal.getsignal(signal.SIGINT) is handler
    assert last_state(tiny, tmp_path).step == number
    monkeypatch.undo()
    train(tiny, tmp_path, resume=True, progress=False, devices=1)
    assert_same_end(tiny, tmp_path, uninterrupted)


@pytest.mark.parametrize("number", [3, 7])
def test_a_killed_run_continues_bit_for_bit(tiny, uninterrupted, tmp_path, at_batch, monkeypatch, number):
    at_batch(number, kill)
    with pytest.raises(Killed):
        train(tiny, tmp_path, progress=False, devices=1)
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"step": 7, "lo')  # a line that was being written
    for name in (".config.99.partial.json", ".log.99.partial.jsonl"):  # files that were being written
        (tmp_path / name).write_text("{")
    monkeypatch.undo()
    train(tiny, tmp_path, resume=True, progress=False, devices=1)
    assert_same_end(tiny, tmp_path, uninterrupted)
    assert not list(tmp_path.glob(".*"))


def test_resuming_a_finished_run_changes_nothing(tiny, uninterrupted):
    before, log = last_state(tiny, uninterrupted), (uninterrupted / "log.jsonl").read_text()
    train(tiny, uninterrupted, resume=True, progress=False, devices=1)
    jax.tree.map(np.testing.assert_array_equal, last_state(tiny, uninterrupted), before)
    assert (uninterrupted / "log.jsonl").read_text() == log


def test_a_network_from_elsewhere_is_trained_on(tiny, uninterrupted, tmp_path):
    """As `parity convert` makes it: weights at step 0, and no position in the data."""
    state = last_state(tiny, uninterrupted)
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(0, state.replace(step=np.zeros_like(state.step)), iterator={})
    checkpoints.close()
    write_config(tmp_path, tiny)
    train(tiny, tmp_path, resume=True, progress=False, devices=1)
    assert int(last_state(tiny, tmp_path).step) == TOTAL


def test_a_folder_that_holds_a_run_needs_resume(tiny, uninterrupted):
    with pytest.raises(ValueError, match="holds a run: add --resume to continue it, or choose another --name"):
        train(tiny, uninterrupted, progress=False, devices=1)


def test_a_run_is_not_continued_with_other_flags(tiny, uninterrupted):
    with pytest.raises(ValueError, match=r"has another config \(seed: 0 -> 1\): continue with its flags, or choose another --name"):
        train(dataclasses.replace(tiny, seed=1), uninterrupted, resume=True, progress=False, devices=1)


@pytest.mark.parametrize("devices", [0, -1, 99])
def test_devices_that_are_none_are_refused_and_leave_no_folder(tiny, tmp_path, devices):
    with pytest.raises(ValueError, match=f"{devices} devices: expected a divisor of the batch"):
        train(tiny, tmp_path / "run", progress=False, devices=devices)
    assert not (tmp_path / "run").exists()


def test_models_for_evaluation_are_refused_before_they_are_prepared(tiny, tmp_path):
    config = dataclasses.replace(tiny, data=dataclasses.replace(tiny.data, source="stanford", root=str(tmp_path)))
    with pytest.raises(ValueError, match=r"data\.source = stanford has no objects to train on"):
        train(config, tmp_path / "run", progress=False)


def test_fewer_points_than_keypoints_are_refused(tiny, tmp_path):
    few = dataclasses.replace(tiny, data=dataclasses.replace(tiny.data, points=20))
    with pytest.raises(ValueError, match=r"data\.points = 20 leaves 15 points after the crop: expected at least 16"):
        train(few, tmp_path / "run", progress=False)


@pytest.mark.parametrize("change", [{"batch": 1000}, {"batch": 6}])
def test_a_run_that_cannot_start_leaves_no_folder(tiny, tmp_path, change):
    config = dataclasses.replace(tiny, optim=dataclasses.replace(tiny.optim, **change))
    with pytest.raises(ValueError, match=r"optim\.batch = 1000|4 devices: expected a divisor of the batch of 6"):
        train(config, tmp_path / "run", progress=False, devices=4)
    assert not (tmp_path / "run").exists()


def test_a_loss_that_is_not_finite_stops_the_run_with_the_batch_saved(tiny, tmp_path, at_batch):
    def poison(batch):
        source = batch["source"].copy()
        source[2, 5, 1] = np.nan
        return {**batch, "source": source}

    at_batch(6, poison)
    path = tmp_path / "not-finite-step-6.npz"
    with pytest.raises(NonFiniteLoss, match=rf"step 6: .*loss = nan.*{path}; the last checkpoint is of step 4"):
        train(tiny, tmp_path, progress=False, devices=1)
    with np.load(path) as saved:
        assert {"source", "target", "R", "t", "views"} == set(saved)
        assert np.isnan(saved["source"][2, 5, 1])
    state = last_state(tiny, tmp_path)
    assert state.step == 4, "the checkpoint before it stays"
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    assert [line["step"] for line in lines(tmp_path) if "loss" in line] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("categories", ["all", "first-half"])
def test_validation_objects_are_training_objects_that_are_never_trained_on(tiny, categories):
    config = dataclasses.replace(tiny, data=dataclasses.replace(tiny.data, categories=categories))
    data = training_data(config)
    assert data.train.objects is data.validation.objects
    assert data.train.objects.split == "train", "the test split has no part in it"
    assert not set(data.train.indices) & set(data.validation.indices)
    labels = Shards(tiny.data.prepared, "train").labels
    chosen = labels >= 0 if categories == "all" else labels < 2
    assert sorted([*data.train.indices, *data.validation.indices]) == np.flatnonzero(chosen).tolist()


def test_validation_pairs_are_the_same_each_time(tiny):
    first, second = training_data(tiny).validation[0], training_data(tiny).validation[0]
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_too_few_points_for_the_keypoints_of_training_are_refused(tiny, tmp_path):
    keypoints = dataclasses.replace(tiny.model.keypoints, count=40, test_count=20)
    config = dataclasses.replace(tiny, model=dataclasses.replace(tiny.model, keypoints=keypoints))
    with pytest.raises(ValueError, match=r"data\.points = 48 leaves 36 points after the crop: expected at least 40"):
        train(config, tmp_path / "run", progress=False)
    assert not (tmp_path / "run").exists()
