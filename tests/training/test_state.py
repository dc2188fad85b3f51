"""The training step: the same on any number of devices, compiled once, safe against bad numbers."""

import re

import jax
import numpy as np
import pytest

from cmig_jax.data.loader import epoch_steps, stack
from cmig_jax.devices import device_mesh, replicated, to_device
from cmig_jax.training.loop import training_data
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import abstract_state, build, create_state, make_step

KEY = jax.random.key(0)
BATCH = 8


@pytest.fixture(scope="module")
def batches(tiny):
    pairs = training_data(tiny).train
    return [stack([pairs[i] for i in range(start, start + BATCH)]) for start in (0, BATCH)]


@pytest.fixture(scope="module")
def parts(tiny):
    model, rule = build(tiny), optimizer(tiny.optim, epoch_steps(training_data(tiny).train, tiny))
    mesh = device_mesh(BATCH, 1)
    return model, rule, mesh, make_step(model, rule, tiny, mesh)


@pytest.fixture(scope="module")
def initial(tiny, parts):
    """A first state, as NumPy arrays, which no step can donate."""
    model, rule, mesh, _ = parts
    return jax.tree.map(np.array, create_state(model, rule, tiny, mesh))


@pytest.fixture
def state(initial, parts):
    return placed(initial, parts[2])


def placed(state, mesh):
    return jax.tree.map(lambda x: jax.device_put(x.copy(), replicated(mesh)), state)


def run(step, state, batches, mesh):
    scalars = []
    for batch in batches:
        state, found = step(state, to_device(batch, mesh), KEY)
        scalars.append({name: float(value) for name, value in found.items()})
    return jax.tree.map(np.array, state), scalars


def test_the_abstract_state_matches_the_created_one(tiny, parts, initial):
    model, rule, mesh, _ = parts
    described = abstract_state(model, rule, tiny, mesh)
    assert jax.tree.structure(described) == jax.tree.structure(initial)
    found = jax.tree.map(lambda x: (x.shape, x.dtype), initial)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), described) == found
    assert {x.sharding for x in jax.tree.leaves(described)} == {replicated(mesh)}


def test_the_state_is_a_function_of_the_seed(tiny, parts, initial):
    model, rule, mesh, _ = parts
    again = create_state(model, rule, tiny, mesh)
    jax.tree.map(np.testing.assert_array_equal, again, initial)


def test_eight_devices_equal_one(tiny, parts, initial, batches):
    model, rule, mesh, step = parts
    eight = device_mesh(BATCH, 8)
    assert len(jax.devices()) == eight.size == 8
    # Compiled with few optimisations, in half the time.
    lowered = make_step(model, rule, tiny, eight).lower(placed(initial, eight), to_device(batches[0], eight), KEY)
    step_of_eight = lowered.compile({"xla_backend_optimization_level": 0})
    of_one_pair = 4 * batches[0]["source"][0].shape[0] ** 2  # a matrix over its points
    assert max(moved_between_devices(step_of_eight.as_text())) < of_one_pair, "a device needs the sums of others, not their pairs"
    one_first, one_scalars = run(step, placed(initial, mesh), batches[:1], mesh)
    all_first, all_scalars = run(step_of_eight, placed(initial, eight), batches[:1], eight)
    one_state, one_second = run(step, placed(one_first, mesh), batches[1:], mesh)
    all_state, all_second = run(step_of_eight, placed(all_first, eight), batches[1:], eight)
    # Sums over the batch are taken in another order: float32 rounding, about 1e-7 of each value, grows through the layers. A loss or a
    # normalisation per device, the faults this looks for, would change these in their first digits.
    for name in set(one_scalars[0]) - {"gradient_norm"}:
        assert all_scalars[0][name] == pytest.approx(one_scalars[0][name], rel=1e-4, abs=1e-5), name
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5), all_first.batch_stats, one_first.batch_stats)
    # Where two neighbours or correspondents are equal up to that rounding, the gradient goes through either.
    assert all_scalars[0]["gradient_norm"] == pytest.approx(one_scalars[0]["gradient_norm"], rel=1e-2)
    one_gradient, all_gradient = (flat(state.opt_state[2].mu) for state in (one_first, all_first))
    assert np.linalg.norm(all_gradient - one_gradient) < 0.05 * np.linalg.norm(one_gradient)
    # Adam divides a gradient by its own size: where it is 0 up to rounding (a bias before a normalisation) its sign, and so a step of
    # up to the learning rate either way, is chance. Those are few; the second step's numbers inherit them.
    apart, moved = (np.abs(flat(one_state.params) - flat(state.params)) for state in (all_state, initial))
    rate = tiny.optim.learning_rate
    assert apart.max() <= 4.01 * rate
    assert np.mean(apart > 0.1 * rate) < 0.05
    assert np.median(moved) > 0.5 * rate, "two steps must move the parameters for this to say anything"
    assert all_second[0]["loss"] == pytest.approx(one_second[0]["loss"], rel=1e-2)


def moved_between_devices(program):
    """List the bytes of what a compiled program gathers or redistributes (sums over the devices, which it needs, aside)."""
    moves = re.findall(r"= (.*?) (?:all-gather|all-to-all|collective-permute)(?:-start)?\(", program)
    sizes = [[int(n) for n in shape.split(",") if n] for move in moves for shape in re.findall(r"[fsu]32\[([\d,]*)\]", move)]
    return [4 * int(np.prod(size)) for size in sizes]


def flat(tree):
    return np.concatenate([leaf.ravel() for leaf in jax.tree.leaves(tree)])


def test_steps_trace_once_and_donate_the_state(parts, state, batches):
    _, _, mesh, step = parts
    donated = jax.tree.leaves(state.params)
    state, _ = step(state, to_device(batches[0], mesh), KEY)
    traces = step._cache_size()
    for batch in batches * 2:
        state, _ = step(state, to_device(batch, mesh), KEY)
    assert step._cache_size() == traces == 1
    assert int(state.step) == 5
    assert all(leaf.is_deleted() for leaf in donated)


def test_the_loss_falls_on_one_repeated_batch_and_every_term_is_named(parts, state, batches):
    _, _, mesh, step = parts
    _, scalars = run(step, state, batches[:1] * 30, mesh)
    assert set(scalars[0]) >= {"loss", "gradient_norm"}
    terms = [value for name, value in scalars[0].items() if name not in ("loss", "gradient_norm")]
    assert len(terms) == 5
    assert sum(terms) == pytest.approx(scalars[0]["loss"], rel=1e-5)
    first, last = (np.mean([found["loss"] for found in part]) for part in (scalars[:3], scalars[-3:]))
    assert last < 0.9 * first


def test_a_step_whose_numbers_are_not_finite_changes_nothing_but_its_number(parts, initial, state, batches):
    _, _, mesh, step = parts
    poisoned = {**batches[0], "source": batches[0]["source"].copy()}
    poisoned["source"][0, 0, 0] = np.nan
    after, scalars = run(step, state, [poisoned], mesh)
    assert not np.isfinite(scalars[0]["loss"])
    assert after.step == 1
    jax.tree.map(np.testing.assert_array_equal, after.replace(step=initial.step), initial)


def test_the_statistics_of_batch_normalisation_move(parts, initial, state, batches):
    _, _, mesh, step = parts
    after, _ = run(step, state, batches[:1], mesh)
    for before, now in zip(*map(jax.tree.leaves, (initial.batch_stats, after.batch_stats)), strict=True):
        assert np.any(before != now)
