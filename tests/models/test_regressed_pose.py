"""What OMNet and FINet have in common: laws of a pose that is regressed in iterations."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.finet.network import FINET, FINetFlags
from cmig_jax.models.omnet.network import OMNET, OMNetFlags
from cmig_jax.models.regressed_pose import QuaternionPose, RegressionFlags, pose_losses
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

SMALL = {"iterations": 2, "regression_widths": (12,), "fusion_widths": (12,)}
OMNET_FLAGS = OMNetFlags(**SMALL, local_widths=(8,), global_widths=(16,), decoder_widths=(8,), unmasked=1)
FINET_FLAGS = FINetFlags(**SMALL, encoder_widths=(6, 12), exchange_after=(1,), regularised=1)
NETWORKS = {"omnet": (OMNET, OMNET_FLAGS), "finet": (FINET, FINET_FLAGS)}
evaluate = jax.jit(predict, static_argnums=0)


def draw(pairs, N, M, dtype=np.float64):
    """Draw pairs of clouds of two parts of an ellipsoid each, and their poses."""
    rng = np.random.default_rng(0)
    pose = RigidTransform(R=Rotation.random(pairs, rng=rng).as_matrix(), t=rng.uniform(-0.5, 0.5, (pairs, 3)))
    points = rng.normal(size=(pairs, N + M, 3))
    points *= np.array([1, 0.7, 0.5]) / np.linalg.norm(points, axis=-1, keepdims=True)
    batch = Batch(source=points[:, :N], target=pose.apply(points[:, N:]), target_from_source=pose)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), batch)


@pytest.fixture(scope="module", params=NETWORKS)
def case(request, random_variables):
    """Return a model, its flags, a module and variables in float64."""
    model, flags = NETWORKS[request.param]
    module = model.build(flags, ComputeConfig())
    return model, flags, module, random_variables(module, draw(2, 5, 5, np.float32), train=False, seed=1)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def assert_same(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-10), a, b)


def training_loss(model, flags, module, compute, variables, batch, key):
    prediction, new = module.apply(variables, batch, train=True, key=key, mutable=["batch_stats"])
    return sum(model.losses(prediction, batch, flags, compute).values()), new["batch_stats"]


def test_the_order_of_points_and_of_pairs_changes_no_pose(case, x64):
    *_, module, variables = case
    batch = draw(2, 30, 40)
    prediction = evaluate(module, variables, batch)
    order, other = np.random.default_rng(1).permutation(30), np.random.default_rng(2).permutation(40)
    permuted = evaluate(module, variables, batch.replace(source=batch.source[:, order], target=batch.target[:, other]))
    assert_same(permuted.target_from_source, prediction.target_from_source)
    reverse = evaluate(module, variables, jax.tree.map(lambda x: x[::-1], batch))
    assert_same(reverse.target_from_source, prediction.target_from_source[::-1])
    if prediction.source_overlap is not None:
        assert_same(permuted.source_overlap, prediction.source_overlap[:, order])
        assert_same(permuted.target_overlap, prediction.target_overlap[:, other])


def test_a_batch_of_two_is_two_batches_of_one_and_sizes_may_differ(case, x64):
    *_, module, variables = case
    batch = draw(2, 30, 40)
    prediction = evaluate(module, variables, batch)
    for i in range(2):
        single = evaluate(module, variables, jax.tree.map(lambda x, i=i: x[i : i + 1], batch))
        assert_same(single, jax.tree.map(lambda x, i=i: x[i : i + 1], prediction))
    R = np.asarray(prediction.target_from_source.R)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.eye(3)[None].repeat(2, 0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)


def test_the_pose_is_what_the_iterations_have_done(case, x64):
    model, flags, module, variables = case
    first = model.build(dataclasses.replace(flags, iterations=1), ComputeConfig())
    of_stage = [{kind: {"stages_0": tree[f"stages_{i}"]} for kind, tree in variables.items()} for i in range(2)]
    batch = draw(2, 30, 30)
    before, after = evaluate(first, of_stage[0], batch).target_from_source, evaluate(module, variables, batch)
    assert_same(before, after.steps[0].pose.transform())
    moved = before.apply(batch.source)
    if model is OMNET:  # its second iteration also depends on masks
        assert_same(after.steps[1].source, moved)
    else:
        step = evaluate(first, of_stage[1], batch.replace(source=moved)).target_from_source
        assert_same(step.compose(before), after.target_from_source)


def test_gradients_are_finite_and_stay_within_their_iteration(case, x64):
    model, flags, module, variables = case
    batch, compute = draw(3, 24, 30), ComputeConfig()

    def second_pose(params):
        tree = variables | {"params": params}
        prediction, _ = module.apply(tree, batch, train=True, key=jax.random.key(0), mutable=["batch_stats"])
        terms = model.losses(prediction, batch, flags, compute)
        return terms["quaternion_1"] + terms["translation_1"]

    gradient = jax.jit(jax.grad(second_pose))(variables["params"])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))
    reached = {name for name, tree in gradient.items() if any(np.any(x) for x in jax.tree.leaves(tree))}
    assert reached == {"stages_1"}


@pytest.mark.slow
def test_a_few_steps_lower_the_loss(case):
    model, flags, _, variables = case
    compute = ComputeConfig(precision="bfloat16") if model is OMNET else ComputeConfig(recompute=True)
    module, batch, optimiser = model.build(flags, compute), draw(4, 24, 30, np.float32), optax.adam(1e-2)
    variables = jax.tree.map(np.float32, variables)
    loss = functools.partial(training_loss, model, flags, module, compute)

    @jax.jit
    def step(variables, state):
        of_params = lambda params: loss(variables | {"params": params}, batch, jax.random.key(0))  # noqa: E731
        (value, statistics), gradient = jax.value_and_grad(of_params, has_aux=True)(variables["params"])
        update, state = optimiser.update(gradient, state)
        return {"params": optax.apply_updates(variables["params"], update), "batch_stats": statistics}, state, value

    state, values = optimiser.init(variables["params"]), []
    for _ in range(20):
        variables, state, value = step(variables, state)
        values.append(float(value))
    assert np.isfinite(values).all()
    assert values[-1] < 0.8 * values[0]


def test_layers_in_bfloat16_give_poses_and_losses_in_float32(case):
    model, flags, _, variables = case
    compute = ComputeConfig(precision="bfloat16")
    module, batch = model.build(flags, compute), draw(4, 24, 30, np.float32)
    variables = jax.tree.map(np.float32, variables)
    loss = functools.partial(training_loss, model, flags, module, compute, batch=batch, key=jax.random.key(0))
    results = jax.eval_shape(loss, variables), jax.eval_shape(functools.partial(predict, module), variables, batch)
    assert {x.dtype for x in jax.tree.leaves(results)} == {jnp.dtype("float32")}


def test_the_true_pose_has_no_loss_and_the_nearer_sign_is_either(x64):
    rng = np.random.default_rng(0)
    quaternion = rng.normal(size=(5, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    pose = QuaternionPose(jnp.asarray(np.where(quaternion[:, :1] < 0, -quaternion, quaternion)), jnp.asarray(rng.normal(size=(5, 3))))
    negative = pose.replace(quaternion=-pose.quaternion)
    official, nearer = RegressionFlags(), RegressionFlags(quaternion_sign="nearer")
    for flags in (official, nearer):
        assert all(value < 1e-12 for value in pose_losses(0, pose, pose.transform(), flags).values())
    assert pose_losses(0, negative, pose.transform(), nearer)["quaternion_0"] < 1e-12
    assert pose_losses(0, negative, pose.transform(), official)["quaternion_0"] > 0.1
    shifted = pose.replace(translation=pose.translation + 0.5)
    assert pose_losses(7, shifted, pose.transform(), official)["translation_7"] == pytest.approx(4 * 0.25)


REFUSED = [
    (OMNetFlags, {"iterations": 0}, "model.iterations = 0: expected at least 1"),
    (OMNetFlags, {"unmasked": 0}, "model.unmasked = 0: expected at least 1"),
    (OMNetFlags, {"class_weights": (0.7, 0.0)}, r"model.class_weights = \(0.7, 0.0\): expected two weights above 0"),
    (OMNetFlags, {"decoder_widths": ()}, r"model.decoder_widths = \(\): expected one or more numbers above 0"),
    (FINetFlags, {"encoder_widths": (8, 0)}, r"model.encoder_widths = \(8, 0\): expected one or more numbers above 0"),
    (FINetFlags, {"exchange_after": (5,)}, r"model.exchange_after = \(5,\): expected layers from 1 to 4"),
    (FINetFlags, {"dropout": 1.0}, r"model.dropout = 1.0: expected a share in \[0, 1\)"),
    (FINetFlags, {"translation_weight": -1.0}, "model.translation_weight = -1.0: expected 0 or more"),
]


@pytest.mark.parametrize(("flags", "values", "message"), REFUSED)
def test_flags_are_refused(flags, values, message):
    with pytest.raises(FlagError, match=message):
        flags(**values)


@pytest.mark.parametrize(("name", "parameters"), [("omnet", 53_658_148), ("finet", 142_199_324)])
def test_the_default_size_is_the_official_one(name, parameters):
    model, _ = NETWORKS[name]
    flags = model.flags()
    module = model.build(flags, ComputeConfig())
    shapes = jax.eval_shape(functools.partial(initial_variables, module, flags.needs), jax.random.key(0))
    assert sum(x.size for x in jax.tree.leaves(shapes["params"])) == parameters
