"""The stream of training batches: reproducible, fresh every epoch, resumed and shared exactly."""

import dataclasses
import itertools
import multiprocessing
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from cmig_jax.config import Config, DataConfig, OptimConfig, ViewsConfig
from cmig_jax.data.loader import epoch_steps, stack, training_batches
from cmig_jax.data.pairs import Pairs
from cmig_jax.models.cmignet.flags import CMIGNetFlags


class Objects:
    """Ten clouds, each near its own number."""

    labels = np.zeros(10, np.int32)
    names = tuple(f"thing {i}" for i in range(10))
    categories = ("thing",)

    def points(self, i):
        return (np.random.default_rng(i).uniform(-0.1, 0.1, (40, 3)) + i).astype(np.float32)

    def views(self, i):
        return np.full((6, 8, 8), i, np.uint8)


def config(batch=4, seed=0):
    data, views = DataConfig(points=40), ViewsConfig(count=6, size=8, layout="axes")
    return Config(name="loader", model=CMIGNetFlags(), seed=seed, data=data, views=views, optim=OptimConfig(batch=batch))


PAIRS = Pairs(Objects(), np.arange(10), config().data, config().views, seed=99)


def take(count, start=0, **process):
    return list(itertools.islice(training_batches(PAIRS, config(), **process), start, start + count))


def assert_same(a, b):
    for x, y in zip(a, b, strict=True):
        assert set(x) == set(y)
        assert all(np.array_equal(x[name], y[name]) for name in x)


def numbers(batch):
    """Tell which objects a batch was made of."""
    return [int(views[0, 0, 0, 0]) for views in batch["views"]]


def test_a_batch_holds_what_training_reads():
    (batch,) = take(1)
    assert {name: value.shape for name, value in batch.items()} == {
        "source": (4, 30, 3),
        "target": (4, 30, 3),
        "R": (4, 3, 3),
        "t": (4, 3),
        "views": (4, 1, 6, 8, 8),
    }
    assert {name: value.dtype.name for name, value in batch.items()} == {
        **dict.fromkeys(("source", "target", "R", "t"), "float32"),
        "views": "uint8",
    }


def test_points_and_views_of_a_row_are_of_one_object():
    for batch in take(3):
        assert numbers(batch) == [round(float(cloud.mean())) for cloud in batch["source"]]


def test_the_same_seed_gives_the_same_batches_and_another_others():
    assert_same(take(5), take(5))
    other = next(training_batches(PAIRS, config(seed=1)))
    assert not np.array_equal(other["R"], take(1)[0]["R"])


def test_an_epoch_visits_no_object_twice_and_drops_the_incomplete_batch():
    assert epoch_steps(PAIRS, config()) == 2
    epochs = [[n for batch in take(2, 2 * epoch) for n in numbers(batch)] for epoch in range(4)]
    assert all(len(set(epoch)) == 8 for epoch in epochs)


def test_epochs_differ_in_order_and_in_what_is_drawn():
    batches = take(20)
    orders = {tuple(n for batch in batches[2 * e : 2 * e + 2] for n in numbers(batch)) for e in range(10)}
    assert len(orders) == 10
    rotations = np.concatenate([batch["R"] for batch in batches]).reshape(80, 9)
    assert len(np.unique(rotations, axis=0)) == 80
    assert {n for batch in batches for n in numbers(batch)} == set(range(10))


@pytest.mark.parametrize("done", [0, 1, 3])
def test_resuming_from_its_state_equals_continuing(done):
    stream = training_batches(PAIRS, config())
    for _ in range(done):
        next(stream)
    state = stream.get_state()
    continued = [next(stream) for _ in range(4)]
    fresh = training_batches(PAIRS, config())
    next(fresh)
    fresh.set_state(state)
    assert_same([next(fresh) for _ in range(4)], continued)
    assert_same(continued, take(4, done))


@pytest.mark.parametrize("processes", [2, 4])
def test_the_shares_of_all_processes_make_the_batch_of_one(processes):
    shares = [take(3, process=i, processes=processes) for i in range(processes)]
    joined = [{name: np.concatenate([part[name] for part in parts]) for name in parts[0]} for parts in zip(*shares, strict=True)]
    assert_same(joined, take(3))


def test_batches_that_cannot_be_made_are_refused():
    with pytest.raises(ValueError, match=r"optim\.batch = 4: expected a multiple of the 3 processes"):
        training_batches(PAIRS, config(), processes=3)
    with pytest.raises(ValueError, match=r"optim\.batch = 11: expected at most the 10 training objects"):
        training_batches(PAIRS, config(batch=11))


def test_pairs_without_views_stack_without_them():
    pairs = Pairs(Objects(), np.arange(10), config().data, None, seed=0)
    assert set(stack([pairs[0], pairs[1]])) == {"source", "target", "R", "t"}


def test_worker_processes_make_the_same_batches_and_leave_interrupts_to_the_training(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2])  # where a worker finds the class above
    workers = dataclasses.replace(config(), data=dataclasses.replace(config().data, workers=1))
    stream = training_batches(PAIRS, workers)
    batches = [next(stream)]
    (worker,) = [child for child in multiprocessing.active_children() if "grain" in child.name]
    os.kill(worker.pid, signal.SIGINT)
    assert_same([*batches, *(next(stream) for _ in range(7))], take(8))
    assert worker.is_alive()
