"""Every row's training step and prediction, traced at toy size: shapes and flags fit each other before hours are spent on them."""

import functools
from dataclasses import replace
from pathlib import Path

import jax
import pytest

from cmig_jax.devices import device_mesh
from cmig_jax.experiments.plan import plan, run_name, with_flags
from cmig_jax.models.base import predict, smallest_batch
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import abstract_state, build, make_step
from configs.catalogue import catalogue
from configs.compared import METHODS
from configs.experiments import EXPERIMENTS

COMPUTED_ALIKE = ("data.", "views.shown")
"""Flags that change what a network is shown, not what it computes."""


def distinct(*, tested):
    """List one job for each thing to compute, in training or test, named by what it changes."""
    found = {}
    for experiment in EXPERIMENTS.values():
        for job in plan(experiment, catalogue(), scale="toy", roots={}, source="shapes", seeds=(0,), runs=Path("runs")):
            flags = {**job.row.flags, **(job.row.test if tested else {})}
            if (
                isinstance(job.training.model, CMIGNetFlags) and "model.matching.iterations" not in flags
            ):  # one is traced in a third of the time of three
                once = {"model.matching.iterations": 1}
                job = replace(job, training=with_flags(job.training, once), test=with_flags(job.test, once))
            named = {flag: value for flag, value in flags.items() if not flag.startswith(COMPUTED_ALIKE)}
            found.setdefault(run_name(job.row.preset, named, 0), job)
    return found


TRAININGS, TESTS = distinct(tested=False), distinct(tested=True)


@functools.cache
def described(config):
    """Describe the mesh, the state and the smallest batch of a training."""
    mesh, rule = device_mesh(1), optimizer(config.optim, 1)
    return mesh, rule, abstract_state(build(config), rule, config, mesh), jax.eval_shape(lambda: smallest_batch(config.model.needs))


def test_all_presets_and_heads_are_among_them():
    assert {name.split("+")[0] for name in TRAININGS} == {
        "paper",
        "released",
        "corrected",
        "own-clouds",
        "own-clouds-cmignet",
        *METHODS.values(),
    }
    assert any("pcrnet" in name for name in TRAININGS)
    assert len(TESTS) > len(TRAININGS) > 20


@pytest.mark.parametrize("name", TRAININGS)
def test_a_row_trains(name):
    config = TRAININGS[name].training
    mesh, rule, state, batch = described(config)
    after, scalars = jax.eval_shape(make_step(build(config), rule, config, mesh), state, batch, jax.random.key(0))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert {"loss", "gradient_norm"} < scalars.keys()


@pytest.mark.parametrize("name", TESTS)
def test_a_row_predicts(name):
    job = TESTS[name]
    *_, state, _ = described(job.training)
    network = job.test.model
    # The smallest batch has no more points than keypoints in training.
    shown = with_flags(job.test, {"model.keypoints.test_count": 0}) if isinstance(network, CMIGNetFlags) else job.test
    batch = jax.eval_shape(lambda: smallest_batch(shown.model.needs)).replace(target_from_source=None)
    predicted = jax.eval_shape(lambda v, b: predict(build(shown), v, b), state.variables, batch)
    assert predicted.target_from_source.R.shape == (1, 3, 3)
    if isinstance(network, CMIGNetFlags):
        assert len(predicted.iterations) == network.matching.iterations + network.matching.repeats
