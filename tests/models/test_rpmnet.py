"""RPM-Net: what its answer depends on, its limit of a sharp matching, derivatives, losses and flags."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.rpmnet.network import RPMNET, RPMNet, RPMNetFlags
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

FLAGS = RPMNetFlags(radius=0.6, neighbours=6, neighbours_by="nearest", dim=16, parameter_widths=(16, 32), parameter_head=(16,))
NETWORK = RPMNet(FLAGS)
evaluate = jax.jit(predict, static_argnums=0)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def batch(N=30, M=34, B=2, seed=0):
    """Return two oriented samplings of an ellipsoid; the source is turned."""
    rng, axes = np.random.default_rng(seed), np.array([1, 0.7, 0.4])

    def cloud(n):
        sphere = rng.normal(size=(B, n, 3))
        sphere /= np.linalg.norm(sphere, axis=-1, keepdims=True)
        normal = sphere / axes
        return sphere * axes, normal / np.linalg.norm(normal, axis=-1, keepdims=True)

    (source, source_normals), (target, target_normals) = cloud(N), cloud(M)
    c, s = np.cos(0.4), np.sin(0.4)
    pose = RigidTransform(R=np.broadcast_to([[c, -s, 0], [s, c, 0], [0, 0, 1]], (B, 3, 3)), t=np.broadcast_to([0.1, 0, -0.1], (B, 3)))
    back = pose.inverse()
    return Batch(back.apply(source), target, None, pose, source_normals @ pose.R, target_normals)


@pytest.fixture(scope="module")
def variables(random_variables):
    drawn = random_variables(NETWORK, batch(), train=False)
    drawn["params"]["parameters"]["last"]["bias"] = np.array([15.0, -1.0])
    return drawn


def assert_same(a, b, atol=1e-9):
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=atol), a, b)


@pytest.mark.slow
def test_it_iterates_more_in_evaluation_and_gives_rotations_and_scores(variables, x64):
    found = evaluate(NETWORK, variables, batch())
    assert len(found.iterations) == 5
    assert len(NETWORK.apply(variables, batch(), train=True).iterations) == 2
    R = np.asarray(found.target_from_source.R)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert found.source_overlap.shape == (2, 30)
    assert found.target_overlap.shape == (2, 34)
    for scores in (found.source_overlap, found.target_overlap):
        assert np.all((scores >= 0) & (scores <= 1))
    np.testing.assert_allclose(np.sum(found.correspondences.weight, axis=-1), 1, atol=1e-3)


def test_the_order_of_points_changes_nothing(variables, x64):
    given, rng = batch(), np.random.default_rng(1)
    i, j = rng.permutation(30), rng.permutation(34)
    shuffled = given.replace(
        source=given.source[:, i],
        source_normals=given.source_normals[:, i],
        target=given.target[:, j],
        target_normals=given.target_normals[:, j],
    )
    ours, other = evaluate(NETWORK, variables, given), evaluate(NETWORK, variables, shuffled)
    assert_same(other.target_from_source, ours.target_from_source)
    assert_same(other.source_overlap, ours.source_overlap[:, i])
    assert_same(j[other.correspondences.partner], np.asarray(ours.correspondences.partner)[:, i])


def test_a_batch_of_two_is_two_of_one(variables, x64):
    whole = evaluate(NETWORK, variables, batch()).target_from_source
    for i in range(2):
        alone = evaluate(NETWORK, variables, jax.tree.map(lambda x, i=i: x[i : i + 1], batch())).target_from_source
        assert_same(alone, whole[i : i + 1])


def test_plain_and_fast_agree(variables, x64):
    plain = RPMNet(FLAGS, ComputeConfig(kernels="plain"))
    assert_same(evaluate(plain, variables, batch()).target_from_source, evaluate(NETWORK, variables, batch()).target_from_source)


def test_a_sharp_matching_lays_a_cloud_on_its_copy(variables, x64):
    sharp = jax.tree.map(np.copy, variables)
    sharp["params"]["parameters"]["last"]["bias"] = np.array([1e4, -2.0])
    given = batch()
    given = given.replace(target=given.source, target_normals=given.source_normals)
    found = evaluate(NETWORK, sharp, given)
    np.testing.assert_array_equal(found.correspondences.partner, np.broadcast_to(np.arange(30), (2, 30)))
    assert_same(found.target_from_source, RigidTransform.identity((2,)), atol=1e-3)


def objective(network, params, given):
    prediction = network.apply({"params": params}, given, train=True)
    return sum(RPMNET.losses(prediction, given, network.flags, network.compute).values())


@pytest.mark.slow
def test_derivatives_are_finite_for_copies_of_points_lonely_points_and_normals_of_0(variables):
    given = jax.tree.map(lambda x: np.array(x, np.float32), batch())
    given.source[:, 3], given.source[:, 5], given.source_normals[:, 7] = given.source[:, 4], 9.0, 0.0
    gradients = jax.jit(jax.grad(functools.partial(objective, NETWORK), argnums=(0, 1)))(variables["params"], given)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(gradients))
    zeros = initial_variables(NETWORK, FLAGS.needs, jax.random.key(0))
    assert zeros["batch_stats"] == {}


def test_terms_are_discounted_and_vanish_for_the_true_pose(variables, x64):
    prediction = jax.jit(functools.partial(NETWORK.apply, train=True))(variables, batch())
    terms = {f: RPMNET.losses(prediction, batch(), dataclasses.replace(FLAGS, discount=f), ComputeConfig()) for f in (1.0, 0.25)}
    for name, value in terms[1.0].items():
        np.testing.assert_allclose(terms[0.25][name], value * (0.25 if name.endswith("_0") else 1))
    right = batch().replace(target_from_source=prediction.target_from_source)
    assert RPMNET.losses(prediction, right, FLAGS, ComputeConfig())["mae_1"] == 0


@pytest.mark.slow
def test_a_few_steps_of_adam_lower_the_loss(random_variables):
    given = jax.tree.map(jnp.float32, batch())
    params = random_variables(NETWORK, given, train=False, dtype=np.float32)["params"]
    optimiser = optax.adam(3e-3)
    step = jax.jit(jax.value_and_grad(functools.partial(objective, NETWORK)))
    state, values = optimiser.init(params), []
    for _ in range(12):
        value, gradient = step(params, given)
        update, state = optimiser.update(gradient, state)
        params = optax.apply_updates(params, update)
        values.append(float(value))
    assert values[-1] < 0.9 * values[0]


def test_without_normals_it_says_what_it_expects(variables):
    with pytest.raises(ValueError, match=r"expected batch\.source_normals and batch\.target_normals, got None"):
        NETWORK.apply(variables, batch().replace(target_normals=None), train=False)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("radius", 0.0), ("neighbours", 0), ("dim", 20), ("parameter_widths", (16, 24)), ("parameter_widths", ())),
        *(("parameter_head", (8,)), ("iterations", 0), ("test_iterations", 0), ("sinkhorn_rounds", -1), ("discount", 0.0)),
        ("outlier_weight", -1.0),
    ],
)
def test_flags_that_are_refused(name, value):
    with pytest.raises(FlagError, match=rf"model\.{name} = .*: expected"):
        RPMNetFlags(**{name: value})
