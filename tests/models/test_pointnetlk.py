"""PointNetLK: the Jacobian is the derivative it claims to be, small motions are found, and nothing breaks on degenerate clouds."""

import functools
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.geometry.twists import exp
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.pointnetlk.flags import PointNetLKFlags, revisited
from cmig_jax.models.pointnetlk.network import POINTNETLK, losses
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

COMPUTE = ComputeConfig()
SMALL = PointNetLKFlags(widths=(8, 16, 32), test_iterations=15)
REVISITED = replace(revisited(), widths=(8, 16, 32), training_points=20)
LEARNING = (replace(SMALL, iterations=3), replace(REVISITED, iterations=3, learn_jacobian=True))


def clouds(B=2, N=30, angle=0.2, seed=0):
    """Pairs of the same points."""
    rng = np.random.default_rng(seed)
    source = rng.normal(size=(B, N, 3)) * (1, 0.7, 0.4)
    pose = exp(jnp.asarray(angle * rng.uniform(-1, 1, (B, 6))))
    return Batch(source=jnp.asarray(source), target=pose.apply(source), target_from_source=pose)


@functools.cache
def network(flags, compute=COMPUTE):
    module = POINTNETLK.build(flags, compute)
    return module, jax.jit(lambda variables, batch: predict(module, variables, batch))


@functools.cache
def variables(flags):
    return jax.jit(functools.partial(initial_variables, network(flags)[0], flags.needs))(jax.random.key(0))


def matrix(flags, batch):
    return np.asarray(network(flags)[1](variables(flags), batch).target_from_source.as_matrix())


@pytest.fixture(autouse=True)
def wide():
    with jax.enable_x64(True):
        yield


def jacobian(flags, target):
    found = variables(REVISITED)
    return jax.jit(lambda x: network(flags)[0].apply(found, x, method="jacobian"))(target)


def test_the_jacobian_is_the_derivative_of_the_features_by_the_twist():
    target = clouds().target
    features, position, J, inverse = map(np.asarray, jacobian(REVISITED, target))
    module, found = network(REVISITED)[0], variables(REVISITED)

    def moved(xi):
        back = exp(-xi[None])
        return module.apply(found, back.apply(target), method=lambda m, x: m.encoder.pooled(x, train=False))

    np.testing.assert_allclose(J, jax.jit(jax.jacrev(moved))(np.zeros(6)), atol=1e-6)
    np.testing.assert_allclose(features, jax.jit(moved)(np.zeros(6)), atol=1e-12)
    np.testing.assert_allclose(inverse @ J, np.broadcast_to(np.eye(6), (2, 6, 6)), atol=1e-6)
    assert position.shape == (2, 32)


def test_differences_of_a_small_step_approach_the_analytic_jacobian():
    target, exact = clouds().target, jacobian(REVISITED, clouds().target)[2]
    errors = [np.abs(jacobian(replace(SMALL, step=step), target)[2] - exact).max() for step in (1e-2, 1e-6)]
    assert errors[1] < 1e-4 < errors[0]


@pytest.mark.parametrize("flags", [SMALL, REVISITED])
def test_small_motions_of_the_same_points_are_found_and_iteration_stops(flags):
    batch = clouds(angle=0.05)
    prediction = network(replace(flags, test_iterations=40))[1](variables(flags), batch)
    np.testing.assert_allclose(prediction.target_from_source.as_matrix(), batch.target_from_source.as_matrix(), atol=1e-5)
    done = np.asarray(prediction.trace.done)
    assert done[-1]
    assert (np.diff(done.astype(int)) >= 0).all()
    stop = int(np.argmax(done))
    poses, twists = prediction.trace.pose.as_matrix(), np.linalg.norm(prediction.trace.twist, axis=-1).max(axis=1)
    np.testing.assert_array_equal(poses[stop:], np.broadcast_to(poses[stop - 1], poses[stop:].shape))
    assert twists[stop] < 1e-7 <= twists[stop - 1]


def test_order_and_translation_of_points_do_not_matter_and_pairs_are_independent():
    batch = clouds()
    whole = matrix(SMALL, batch)
    order = np.random.default_rng(1).permutation(30)
    np.testing.assert_allclose(matrix(SMALL, batch.replace(source=batch.source[:, order])), whole, atol=1e-9)
    shift = np.array([1.0, -2.0, 3.0])
    moved = matrix(SMALL, batch.replace(source=batch.source + shift[None, None]))
    np.testing.assert_allclose(moved[:, :3, :3], whole[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(moved[:, :3, 3], whole[:, :3, 3] - whole[:, :3, :3] @ shift, atol=1e-8)
    alone = [matrix(SMALL, jax.tree.map(lambda x, i=i: x[i : i + 1], batch)) for i in range(2)]
    np.testing.assert_allclose(np.concatenate(alone), whole, atol=1e-6)  # a pair that has converged goes on while another has not


@functools.cache
def training(flags, compute=COMPUTE):
    module, statistics = POINTNETLK.build(flags, compute), wide_variables(flags)["batch_stats"]

    def loss(params, batch):
        state = {"params": params, "batch_stats": statistics}
        prediction, _ = module.apply(state, batch, train=True, key=jax.random.key(0), mutable=["batch_stats"])
        return sum(losses(prediction, batch, flags, compute).values())

    return jax.jit(jax.value_and_grad(loss))


def wide_variables(flags):
    return jax.tree.map(lambda x: x.astype(jnp.float64), variables(flags))


def unequal():
    batch = clouds(angle=0.3)
    return batch.replace(source=batch.source[:, :25])


@pytest.mark.slow
@pytest.mark.parametrize("flags", LEARNING)
def test_a_few_steps_lower_the_loss_for_clouds_of_unequal_size(flags):
    params, adam, values = wide_variables(flags)["params"], optax.adam(2e-3), []
    state = adam.init(params)
    for _ in range(12):
        value, gradient = training(flags)(params, unequal())
        updates, state = adam.update(gradient, state)
        params = optax.apply_updates(params, updates)
        values.append(float(value))
    assert np.isfinite(values).all()
    assert min(values[6:]) < 0.8 * values[0]


@pytest.mark.parametrize("flags", LEARNING)
@pytest.mark.parametrize("degenerate", ["a point", "a line"])
def test_pose_and_gradient_are_finite_for_degenerate_clouds(flags, degenerate):
    scale = jnp.asarray([0.0 if degenerate == "a point" else 1.0, 0, 0])
    batch = unequal()
    batch = batch.replace(source=batch.source * scale[None, None], target=batch.target * scale[None, None])
    assert np.isfinite(matrix(flags, batch)).all()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(training(flags)(wide_variables(flags)["params"], batch)))


def test_recomputing_changes_no_gradient():
    flags = LEARNING[1]
    once, again = (training(flags, ComputeConfig(recompute=r))(wide_variables(flags)["params"], unequal()) for r in (False, True))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12), once, again)


def test_statistics_move_twice_the_later_call_weighs_more_and_given_draws_replace_the_key():
    flags, batch = replace(REVISITED, training_points=5, iterations=1), clouds()
    found, index = wide_variables(flags), jnp.arange(5)
    module = network(flags)[0]
    draws = {"statistics_index": index, "point_index": index + 5}
    _, new = jax.jit(functools.partial(module.apply, train=True, mutable=["batch_stats"]))(found, batch, **draws)
    layers, (layer,) = found["params"]["encoder"]["layers"], ("layer_0",)
    means = [
        np.mean((cloud - cloud.mean(1, keepdims=True))[:, :5] @ layers[layer]["kernel"] + layers[layer]["bias"][None, None], (0, 1))
        for cloud in (batch.target, batch.source)
    ]
    np.testing.assert_allclose(new["batch_stats"]["encoder"]["layers"]["norm_0"]["mean"], 0.09 * means[0] + 0.1 * means[1], atol=1e-12)
    with pytest.raises(ValueError, match="expected a random key"):
        module.apply(found, batch, train=True, mutable=["batch_stats"])
    with pytest.raises(ValueError, match=re.escape("training-points = 40: expected at most the 30 points")):
        network(replace(flags, training_points=40))[0].apply(found, batch, train=True, key=jax.random.key(0), mutable=["batch_stats"])


def test_flags_that_cannot_be_are_refused():
    for change, message in (
        ({"widths": (8, 4)}, "model.widths"),
        ({"step": 0.0}, "model.step"),
        ({"iterations": 0}, "model.iterations"),
        ({"test_iterations": 0}, "model.test-iterations"),
        ({"training_points": -1}, "model.training-points"),
    ):
        with pytest.raises(FlagError, match=message):
            PointNetLKFlags(**change)
    assert PointNetLKFlags(training_points=7).needs.training_points == 7
    assert isinstance(clouds().target_from_source, RigidTransform)
