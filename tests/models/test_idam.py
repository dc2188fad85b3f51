"""IDAM: what its pose depends on, its layers pair by pair, the drawn keypoints, losses, derivatives and flags."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.models.base import predict
from cmig_jax.models.cmignet.heads import KeypointSet
from cmig_jax.models.idam.network import IDAM, GraphLayer, IDAMFlags, IDAMNetwork, Matcher
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

FLAGS = IDAMFlags(k=5, layers=2, dim=8, significance_widths=(8,), pair_width=6, points_per_keypoint=3, iterations=2)
NETWORK = IDAMNetwork(FLAGS)
SHORT = dataclasses.replace(FLAGS, layers=1, iterations=1)
EPS = 1e-5  # of BatchNorm
evaluate = jax.jit(predict, static_argnums=0)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def pairs(N=30, M=24, shared=12):
    """Return a source and a target that share some points, the first of the source, and the true poses."""
    rng = np.random.default_rng(0)
    truth = RigidTransform(R=Rotation.random(2, rng=rng).as_matrix(), t=rng.normal(size=(2, 3)))
    source, target = rng.normal(size=(2, N, 3)), rng.normal(size=(2, M, 3))
    target[:, M - shared :] = np.asarray(source[:, :shared] @ truth.R.swapaxes(1, 2) + truth.t[:, None])
    return Batch(source, target, target_from_source=truth)


@pytest.fixture(scope="module")
def variables(random_variables):
    """Draw weights that give distinct partners: most seeds match all keypoints to one or two, and no rotation is defined."""
    drawn = random_variables(NETWORK, pairs(), seed=78, train=False)
    for i in range(FLAGS.iterations):
        drawn["params"][f"matchers_{i}"]["first"]["kernel"][2 * FLAGS.dim :] *= 8  # distances and directions weigh more
    return drawn


def assert_same(a, b, atol=1e-9):
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=atol), a, b)


@functools.partial(jax.jit, static_argnums=0)
def train(network, variables, given, **options):
    prediction, _ = network.apply(variables, given, train=True, mutable=["batch_stats"], **options)
    return prediction


@functools.partial(jax.jit, static_argnums=0)
@functools.partial(jax.value_and_grad, argnums=1)
def objective(network, params, variables, given, **options):
    prediction = train(network, {**variables, "params": params}, given, **options)
    return sum(IDAM.losses(prediction, given, network.flags, network.compute).values())


def test_the_poses_compared_here_are_defined(variables, x64):
    for iteration in evaluate(NETWORK, variables, pairs()).iterations:
        x, y = (np.asarray(points - points.mean(1, keepdims=True)) for points in (iteration.source, iteration.corresponding))
        values = np.linalg.svd(np.einsum("bk,bki,bkj->bij", iteration.weight, x, y))[1]
        assert np.all(values[:, 1] > 0.1 * values[:, 0])


def test_the_order_of_points_changes_nothing(variables, x64):
    given, rng = pairs(), np.random.default_rng(1)
    i, j = rng.permutation(30), rng.permutation(24)
    ours = evaluate(NETWORK, variables, given)
    other = evaluate(NETWORK, variables, given.replace(source=given.source[:, i], target=given.target[:, j]))
    assert_same(other.target_from_source, ours.target_from_source)
    assert_same(i[other.correspondences.source_index], ours.correspondences.source_index)
    assert_same(j[other.correspondences.target_index], ours.correspondences.target_index)
    assert_same(other.correspondences.partner, ours.correspondences.partner)


def test_the_pose_is_that_of_all_steps_one_after_the_other(variables, x64):
    found, given = evaluate(NETWORK, variables, pairs()), pairs()
    keypoints = np.take_along_axis(given.source, np.asarray(found.correspondences.source_index)[..., None], axis=1)
    assert_same(found.target_from_source.apply(keypoints), found.iterations[-1].step.apply(found.iterations[-1].source))


def test_a_batch_of_two_is_two_of_one(variables, x64):
    whole = evaluate(NETWORK, variables, pairs()).target_from_source
    for i in range(2):
        assert_same(evaluate(NETWORK, variables, jax.tree.map(lambda x, i=i: x[i : i + 1], pairs())).target_from_source, whole[i : i + 1])


def test_the_origin_is_of_no_account(variables, x64):
    given, shift = pairs(), RigidTransform(R=np.broadcast_to(np.eye(3), (2, 3, 3)), t=np.broadcast_to([2.0, -1, 3], (2, 3)))
    moved = given.replace(source=shift.apply(given.source), target=shift.apply(given.target))
    pose = evaluate(NETWORK, variables, given).target_from_source
    assert_same(evaluate(NETWORK, variables, moved).target_from_source, shift.compose(pose).compose(shift.inverse()))


@pytest.mark.parametrize(("per_keypoint", "counts"), [(3, (10, 10)), (1, (30, 24))])
def test_the_source_says_how_many_keypoints_there_are(variables, x64, per_keypoint, counts):
    found = evaluate(IDAMNetwork(dataclasses.replace(SHORT, points_per_keypoint=per_keypoint)), variables, pairs())
    chosen = found.correspondences
    assert (chosen.source_index.shape[1], chosen.target_index.shape[1]) == counts
    for scores, index in ((found.source_scores, chosen.source_index), (found.target_scores, chosen.target_index)):
        np.testing.assert_array_equal(index, np.argsort(-np.asarray(scores), axis=1)[:, : index.shape[1]])
    np.testing.assert_allclose(np.sum(chosen.weight, axis=-1), 1, atol=1e-6)


@pytest.mark.parametrize("count", [9, 10])
def test_right_partners_give_the_right_pose_from_the_more_valid_half(x64, count):
    rng, given = np.random.default_rng(2), pairs()
    source, order = given.source[:, :count], rng.permutation(count)
    target, logit = given.target_from_source.apply(source)[:, order], rng.normal(size=(2, count))
    match = 30.0 * np.broadcast_to(np.argsort(order)[:, None] == np.arange(count), (2, count, count))
    found = jax.jit(NETWORK.solve)(source, target, match, logit)
    assert_same(found.step, given.target_from_source)
    assert np.max(found.match) == 20
    kept = logit >= np.sort(logit, axis=1)[:, [(count - 1) // 2]]  # the lower median and what is above
    expected = kept / (1 + np.exp(-logit))
    assert_same(found.weight, expected / expected.sum(1, keepdims=True), atol=1e-7)
    gradient = jax.jit(jax.grad(lambda *x: jnp.sum(NETWORK.solve(source, target, *x).step.R[:, 0]), argnums=(0, 1)))(match, logit)
    assert_same(gradient, jax.tree.map(jnp.zeros_like, gradient), atol=0)


def normalised(x, axes=(0, 1, 2)):
    return (x - x.mean(axes)) / np.sqrt(x.var(axes) + EPS)


def test_a_graph_layer_reads_differences_from_neighbours(random_variables, x64):
    rng = np.random.default_rng(3)
    x, graph = rng.normal(size=(2, 9, 3)), rng.integers(0, 9, (2, 9, 4))
    layer = GraphLayer(8)
    drawn = random_variables(layer, x, graph, train=False)
    p = drawn["params"]
    found, _ = layer.apply(drawn, x, graph, train=True, mutable=["batch_stats"])
    edges = np.stack([cloud[i] - cloud[:, None] for cloud, i in zip(x, graph, strict=True)]) @ p["edge_first"]["kernel"]
    edges = np.maximum(normalised(edges) * p["edge_norm"]["scale"] + p["edge_norm"]["bias"], 0)
    pooled = (edges @ p["edge_last"]["kernel"] + p["edge_last"]["bias"]).max(2)
    assert_same(found, pooled @ p["point"]["kernel"] + p["point"]["bias"])


def test_a_pair_has_both_features_the_distance_and_the_direction(random_variables, x64):
    rng, matcher = np.random.default_rng(4), Matcher(8, 6)
    source, target = (KeypointSet(points=rng.normal(size=(2, K, 3)), features=rng.normal(size=(2, K, 8))) for K in (5, 7))
    target.points[:, 3] = source.points[:, 2]
    drawn = random_variables(matcher, source, target, train=False)
    p = drawn["params"]
    found, _ = matcher.apply(drawn, source, target, True, method="pairs", mutable=["batch_stats"])
    offset = source.points[:, :, None] - target.points[:, None]
    distance = np.linalg.norm(offset, axis=-1, keepdims=True)
    f, g = (np.broadcast_to(x, (2, 5, 7, 8)) for x in (source.features[:, :, None], target.features[:, None]))
    values = np.concatenate([f, g, distance, offset / (distance + 1e-8)], axis=-1) @ p["first"]["kernel"]
    hidden = np.maximum(normalised(values) * p["first_norm"]["scale"] + p["first_norm"]["bias"], 0)
    assert_same(found, hidden @ p["last"]["kernel"] + p["last"]["bias"])


def test_half_of_the_drawn_keypoints_have_a_partner_and_all_meet_their_nearest_point(variables, x64):
    given, key = pairs(), jax.random.key(0)
    chosen = train(NETWORK, variables, given, key=key).keypoints
    moved = np.take_along_axis(np.asarray(given.target_from_source.apply(given.source)), np.asarray(chosen.source_index)[..., None], axis=1)
    distance = np.linalg.norm(moved[:, :, None] - given.target[:, None], axis=-1)
    np.testing.assert_array_equal(chosen.target_index, distance.argmin(-1))
    np.testing.assert_array_equal(chosen.match_label, distance.min(-1) < FLAGS.match_threshold)
    np.testing.assert_array_equal(np.asarray(chosen.source_index) < 12, np.broadcast_to(np.arange(10) < 5, (2, 10)))


def test_the_losses(variables, x64):
    given = pairs()
    found = train(NETWORK, variables, given, key=jax.random.key(1))
    terms = IDAM.losses(found, given, FLAGS, ComputeConfig())
    label, own = np.asarray(found.keypoints.match_label), np.arange(10)
    mask = 0.0
    for scores, index, axis in (
        (found.source_scores, found.keypoints.source_index, 2),
        (found.target_scores, found.keypoints.target_index, 1),
    ):
        p = np.asarray(jax.nn.softmax(found.iterations[0].match, axis=axis))
        mask += np.mean((np.take_along_axis(np.asarray(scores), np.asarray(index), 1) - np.sum(p * np.log(p), axis=axis)) ** 2)
    expected = {"mask": mask}
    for i, iteration in enumerate(found.iterations):
        p, logit = np.asarray(jax.nn.softmax(iteration.match, axis=-1)), np.asarray(iteration.logit)
        expected[f"matching_{i}"] = -np.sum(label * np.log(p[:, own, own])) / label.sum()
        right = np.asarray(iteration.correspondence) == own
        expected[f"credibility_{i}"] = np.mean(np.log1p(np.exp(logit)) - right * logit)
    assert_same(terms, expected)


def test_without_a_pair_in_reach_matching_costs_nothing_and_by_distance_no_partner_is_right(variables, x64):
    given = pairs()
    given = given.replace(target_from_source=given.target_from_source.replace(t=given.target_from_source.t + 50))
    flags = dataclasses.replace(FLAGS, credibility_label="distance")
    found = train(NETWORK, variables, given, key=jax.random.key(1))
    terms = IDAM.losses(found, given, flags, ComputeConfig())
    for i, iteration in enumerate(found.iterations):
        assert terms[f"matching_{i}"] == 0
        np.testing.assert_allclose(terms[f"credibility_{i}"], np.mean(np.log1p(np.exp(np.asarray(iteration.logit)))))


@pytest.mark.slow
def test_plain_and_fast_agree(variables, x64):
    def both(network):
        return objective(network, variables["params"], variables, pairs(30, 30), key=jax.random.key(0))

    assert_same(both(IDAMNetwork(SHORT, ComputeConfig(kernels="plain"))), both(IDAMNetwork(SHORT)))


def test_derivatives_are_finite_for_points_on_their_partners_and_copies_of_points(variables, x64):
    given = pairs(30, 30)
    given.source[:, 3] = given.source[:, 4]
    given = given.replace(
        target=given.source, target_from_source=RigidTransform(R=np.broadcast_to(np.eye(3), (2, 3, 3)), t=np.zeros((2, 3)))
    )
    _, gradients = objective(IDAMNetwork(SHORT), variables["params"], variables, given, key=jax.random.key(0))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(gradients))


def test_geometry_stays_wide_where_layers_are_narrow(variables):
    given, single = jax.tree.map(jnp.float32, pairs()), jax.tree.map(jnp.float32, variables)
    found = evaluate(IDAMNetwork(SHORT, ComputeConfig(precision="bfloat16")), single, given)
    for x in jax.tree.leaves((found.target_from_source, found.source_scores, found.iterations[0])):
        assert x.dtype in (jnp.float32, jnp.int32)
    R = np.asarray(found.target_from_source.R)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-5)


def test_a_few_steps_of_adam_lower_the_loss(variables, x64):
    network, given = IDAMNetwork(SHORT), pairs(30, 30)
    params, optimiser = variables["params"], optax.adam(1e-2)
    state, values, change = optimiser.init(params), [], jax.jit(optimiser.update)
    for _ in range(12):
        value, gradient = objective(network, params, variables, given, key=jax.random.key(0))
        update, state = change(gradient, state)
        params = optax.apply_updates(params, update)
        values.append(float(value))
    assert values[-1] < 0.8 * values[0]


def test_it_says_what_it_expects(variables, x64):
    given = pairs()
    with pytest.raises(ValueError, match=r"at least 9 points .* got 30 and 8"):
        NETWORK.apply(variables, given.replace(target=given.target[:, :8]), train=False)
    with pytest.raises(ValueError, match=r"a key or source_index"):
        train(NETWORK, variables, given)
    with pytest.raises(ValueError, match=r"expected batch\.target_from_source"):
        train(NETWORK, variables, given.replace(target_from_source=None), key=jax.random.key(0))


def test_it_needs_neighbours_and_three_keypoints():
    assert (IDAMFlags().needs.points, dataclasses.replace(FLAGS, k=11).needs.training_points, IDAMFlags().needs.pairs) == (18, 11, 1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("k", 0), ("layers", 0), ("dim", 0), ("significance_widths", ()), ("significance_widths", (8, 0)), ("pair_width", 0)),
        *(("points_per_keypoint", 0), ("iterations", 0), ("match_threshold", 0.0)),
    ],
)
def test_flags_that_are_refused(name, value):
    with pytest.raises(FlagError, match=rf"model\.{name} = .*: expected"):
        IDAMFlags(**{name: value})
