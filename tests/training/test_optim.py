"""Adam, its decay and its schedules, against the formulas written out."""

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmig_jax.config import OptimConfig
from cmig_jax.training.optim import optimizer, schedule

RATE = 0.1


def updated(config, gradients, start, steps_per_epoch=10):
    """Apply the rule to a sequence of gradients of one array."""
    rule, parameters = optimizer(config, steps_per_epoch), jnp.asarray(start)
    state = rule.init(parameters)
    for gradient in gradients:
        change, state = rule.update(jnp.asarray(gradient), state, parameters)
        parameters = optax.apply_updates(parameters, change)
    return np.asarray(parameters)


def adam(gradients, start, decay):
    """PyTorch's `Adam(weight_decay)`: the decay is part of the gradient that the moments see."""
    parameters, first, second = np.array(start, np.float64), 0.0, 0.0
    for step, gradient in enumerate(gradients, start=1):
        gradient = gradient + decay * parameters
        first, second = 0.9 * first + 0.1 * gradient, 0.999 * second + 0.001 * gradient**2
        parameters = parameters - RATE * (first / (1 - 0.9**step)) / (np.sqrt(second / (1 - 0.999**step)) + 1e-8)
    return parameters


@pytest.fixture
def gradients():
    return list(np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32))


@pytest.mark.parametrize("decay", [0.0, 0.5])
def test_decay_enters_the_gradient_before_the_moments(gradients, decay):
    start = np.array([1, -2, 3, 0.5], np.float32)
    found = updated(OptimConfig(learning_rate=RATE, weight_decay=decay), gradients, start)
    np.testing.assert_allclose(found, adam(gradients, start, decay), rtol=1e-5, atol=1e-5)  # float32 Adam against float64


def test_the_size_of_a_first_gradient_that_is_all_decay_does_not_matter():
    start = np.array([1, -2, 3, 0.5], np.float32)
    found = updated(OptimConfig(learning_rate=RATE, weight_decay=1e-2), [np.zeros(4, np.float32)], start)
    np.testing.assert_allclose(found, start - RATE * np.sign(start), rtol=1e-5)  # AdamW would subtract RATE * decay * start


def test_clipping_is_off_by_default_and_bounds_the_global_norm_when_on():
    # Without the decay a first step of Adam forgets the size of the gradient; two gradients of very different sizes tell.
    gradients, start = [np.full(4, 100, np.float32), np.full(4, 1, np.float32)], np.zeros(4, np.float32)
    plain = OptimConfig(learning_rate=RATE, weight_decay=0)
    assert plain.clip_norm == 0
    np.testing.assert_allclose(updated(plain, gradients, start), adam(gradients, start, 0), rtol=1e-5)
    clipped = OptimConfig(learning_rate=RATE, weight_decay=0, clip_norm=1.0)
    np.testing.assert_allclose(updated(clipped, gradients, start), adam([np.full(4, 0.5)] * 2, start, 0), rtol=1e-5)


def test_the_step_schedule_halves_after_the_epochs_named():
    rate = schedule(OptimConfig(learning_rate=RATE, milestones=(2, 3)), steps_per_epoch=10)
    found = [float(np.asarray(rate(step))) for step in (0, 19, 20, 29, 30, 1000)]
    np.testing.assert_allclose(found, [RATE, RATE, RATE / 2, RATE / 2, RATE / 4, RATE / 4], rtol=1e-6)


def test_the_cosine_schedule_warms_up_linearly_and_ends_at_a_hundredth():
    rate = schedule(OptimConfig(learning_rate=RATE, schedule="cosine", epochs=10), steps_per_epoch=20)
    warm_up = [float(np.asarray(rate(step))) for step in range(11)]
    np.testing.assert_allclose(warm_up, np.linspace(0.05 * RATE, RATE, 11), rtol=1e-5)
    np.testing.assert_allclose(float(np.asarray(rate(105))), RATE * (0.01 + 0.99 / 2), rtol=1e-5)  # half-way down
    np.testing.assert_allclose(float(np.asarray(rate(200))), 0.01 * RATE, rtol=1e-5)


def test_the_shortest_run_has_a_schedule():
    rate = schedule(OptimConfig(schedule="cosine", epochs=1), steps_per_epoch=1)
    assert np.isfinite([float(np.asarray(rate(step))) for step in range(3)]).all()
