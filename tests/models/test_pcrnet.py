"""PCRNet: the pose is that of the accumulated steps, for clouds wherever they are; and the Chamfer distance that it learns from."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.geometry.distances import chamfer_distance
from cmig_jax.geometry.twists import exp
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.pcrnet.flags import PCRNetFlags
from cmig_jax.models.pcrnet.network import PCRNET, losses
from cmig_jax.structs import Batch

COMPUTE = ComputeConfig()
SMALL = PCRNetFlags(widths=(8, 16), head_widths=(16,), iterations=3, from_identity=True)


@pytest.fixture(autouse=True)
def wide():
    with jax.enable_x64(True):
        yield


def clouds(B=2, N=30, M=24, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(B, max(N, M), 3)) * (1, 0.7, 0.4)
    pose = exp(jnp.asarray(0.5 * rng.uniform(-1, 1, (B, 6))))
    return Batch(source=jnp.asarray(points[:, :N]), target=pose.apply(points[:, :M]), target_from_source=pose)


@functools.cache
def network(flags, compute=COMPUTE):
    module = PCRNET.build(flags, compute)
    return module, jax.jit(lambda variables, batch: predict(module, variables, batch).target_from_source.as_matrix())


@functools.cache
def variables(flags=SMALL):
    return jax.tree.map(
        lambda x: x.astype(jnp.float64), initial_variables(PCRNET.build(flags, ComputeConfig()), flags.needs, jax.random.key(0))
    )


def test_order_and_translation_of_points_do_not_matter_and_pairs_are_independent():
    batch, rng = clouds(), np.random.default_rng(1)
    whole = np.asarray(network(SMALL)[1](variables(), batch))
    R = whole[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    mixed = batch.replace(source=batch.source[:, rng.permutation(30)], target=batch.target[:, rng.permutation(24)])
    np.testing.assert_allclose(network(SMALL)[1](variables(), mixed), whole, atol=1e-12)
    of_source, of_target = rng.normal(size=(2, 3))
    moved = batch.replace(source=batch.source + of_source[None, None], target=batch.target + of_target[None, None])
    expected = whole.copy()
    expected[:, :3, 3] += of_target - R @ of_source
    np.testing.assert_allclose(network(SMALL)[1](variables(), moved), expected, atol=1e-12)
    alone = [network(SMALL)[1](variables(), jax.tree.map(lambda x, i=i: x[i : i + 1], batch)) for i in range(2)]
    np.testing.assert_allclose(np.concatenate(alone), whole, atol=1e-12)


def test_the_pose_moves_the_centred_source_to_where_the_last_step_left_it():
    batch = clouds()
    source, target = (x - x.mean(1, keepdims=True) for x in (batch.source, batch.target))
    register = jax.jit(functools.partial(network(SMALL)[0].apply, variables(), method="register"))
    feature, steps = register(source, target)
    assert feature.shape == (2, 16)
    for i in range(3):
        np.testing.assert_allclose(steps.pose[i].apply(source), steps.source[i], atol=1e-12)
        again = register(steps.source[i], target)[1]
        if i < 2:
            np.testing.assert_allclose(again.source[0], steps.source[i + 1], atol=1e-12)


@functools.cache
def training(flags, compute=COMPUTE):
    module = PCRNET.build(flags, compute)

    def loss(params, batch):
        prediction = module.apply({"params": params}, batch, train=True, key=jax.random.key(0))
        return sum(losses(prediction, batch, flags, compute).values())

    return jax.jit(jax.value_and_grad(loss))


def test_a_few_steps_lower_the_loss():
    batch, params, adam = clouds(B=3), variables()["params"], optax.adam(3e-3)
    state, values = adam.init(params), []
    for _ in range(12):
        value, gradient = training(SMALL)(params, batch)
        updates, state = adam.update(gradient, state)
        params = optax.apply_updates(params, updates)
        values.append(float(value))
    assert values[-1] < 0.9 * values[0]


def test_recomputing_changes_no_gradient():
    once, again = (training(SMALL, ComputeConfig(recompute=recompute))(variables()["params"], clouds()) for recompute in (False, True))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-13), once, again)


def test_without_weights_the_network_moves_nothing_only_if_it_starts_from_the_identity():
    batch = clouds()
    zeros = jax.tree.map(jnp.zeros_like, variables())
    pose = np.asarray(network(SMALL)[1](zeros, batch))
    np.testing.assert_allclose(pose[:, :3, :3], np.broadcast_to(np.eye(3), (2, 3, 3)), atol=0)
    np.testing.assert_allclose(pose[:, :3, 3], batch.target.mean(1) - batch.source.mean(1), atol=1e-14)
    value, gradient = training(replace(SMALL, from_identity=False))(zeros["params"], batch)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((value, gradient)))


def test_the_chamfer_distance_is_the_mean_distance_to_the_nearest_point_both_ways():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 7, 3)), rng.normal(size=(2, 5, 3))
    between = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1)
    expected = (between.min(2).mean(1) + between.min(1).mean(1)) / 2
    chamfer = jax.jit(chamfer_distance)
    np.testing.assert_allclose(chamfer(a, b), expected, atol=1e-14)
    np.testing.assert_allclose(chamfer(b, a), expected, atol=1e-14)
    R, t = np.asarray(exp(jnp.arange(6.0)).R), rng.normal(size=3)
    np.testing.assert_allclose(chamfer(a @ R.T + t, b @ R.T + t), expected, atol=1e-13)

    def plain(a):
        distance = jnp.sqrt(jnp.sum((a[:, :, None] - b[:, None]) ** 2, -1))
        return jnp.sum(distance.min(2).mean(1) + distance.min(1).mean(1)) / 2

    both = (jax.jit(jax.grad(f))(jnp.asarray(a)) for f in (plain, lambda a: jnp.sum(chamfer_distance(a, b))))
    np.testing.assert_allclose(*both, atol=1e-14)


def test_the_chamfer_distance_of_equal_sets_is_zero_with_derivative_zero():
    a = np.random.default_rng(0).normal(size=(2, 6, 3)).astype(np.float32) + 10
    value, gradient = jax.value_and_grad(lambda x: jnp.sum(chamfer_distance(x, a[:, ::-1])))(jnp.asarray(a))
    assert value.dtype == jnp.float32
    np.testing.assert_array_equal(value, 0)
    np.testing.assert_array_equal(gradient, 0)


def test_flags_that_cannot_be_are_refused():
    for change, message in (
        ({"widths": ()}, "model.widths"),
        ({"head_widths": (0,)}, "model.head-widths"),
        ({"iterations": 0}, "model.iter"),
    ):
        with pytest.raises(FlagError, match=message):
            PCRNetFlags(**change)
