"""The network as a function: what its results depend on, and the parts of a prediction."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import predict
from cmig_jax.models.cmignet.heads import KeypointSet, Match
from cmig_jax.models.cmignet.network import CMIGNet
from cmig_jax.models.cmignet.solve import credible_half
from cmig_jax.ops.procrustes import weighted_procrustes

evaluate = jax.jit(predict, static_argnums=0)


@pytest.fixture(scope="module")
def network(tiny_flags, pairs, random_variables):
    """Return the paper's network, tiny, with variables in float64."""
    net = CMIGNet(tiny_flags())
    return net, random_variables(net, pairs(), seed=24, train=False)


@pytest.fixture(scope="module")
def batch(network, pairs):
    """Return two pairs of 70 and 90 points, with the features of their views: programs without the image encoder compile sooner."""
    net, variables = network
    encode = jax.jit(lambda views: net.apply(variables, views, method=lambda m, x: m.views(x, train=False)))
    with jax.enable_x64(True):
        return pairs().replace(views=encode(pairs().views))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def prediction(network, batch):
    with jax.enable_x64(True):
        return evaluate(*network, batch)


def assert_same(a, b, atol=1e-9):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


def test_the_pose_of_the_tests_below_rests_on_several_correspondences(prediction):
    assert prediction.target_from_source.R.dtype == jnp.float64
    for iteration in prediction.iterations:
        used = np.where(np.asarray(iteration.weight) > 0, iteration.correspondence, -1)
        assert all(len(set(row)) > 4 for row in used)
    for scores in (prediction.source_scores, prediction.target_scores):
        assert all(len(set(row)) == scores.shape[1] for row in np.asarray(scores))


def test_clouds_of_different_size_give_rotations(prediction):
    R = np.asarray(prediction.target_from_source.R)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.eye(3)[None].repeat(2, 0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    assert (prediction.source_scores.shape, prediction.target_scores.shape) == ((2, 70), (2, 90))


def test_the_order_of_points_permutes_the_scores_and_keeps_the_pose(network, prediction, batch, x64):
    order, other = np.random.default_rng(1).permutation(70), np.random.default_rng(2).permutation(90)
    permuted = evaluate(*network, batch.replace(source=batch.source[:, order], target=batch.target[:, other]))
    np.testing.assert_allclose(permuted.source_scores, prediction.source_scores[:, order], atol=1e-9)
    np.testing.assert_allclose(permuted.target_scores, prediction.target_scores[:, other], atol=1e-9)
    assert_same(permuted.target_from_source, prediction.target_from_source)


def test_the_order_of_pairs_permutes_the_predictions(network, prediction, batch, x64):
    assert_same(evaluate(*network, jax.tree.map(lambda x: x[::-1], batch)), jax.tree.map(lambda x: x[::-1], prediction))


def test_a_batch_of_two_is_two_batches_of_one(network, prediction, batch, x64):
    for i in range(2):
        single = evaluate(*network, jax.tree.map(lambda x, i=i: x[i : i + 1], batch))
        assert_same(single, jax.tree.map(lambda x, i=i: x[i : i + 1], prediction))


def test_features_of_views_stand_for_the_views_and_the_true_pose_is_not_read(network, prediction, pairs, x64):
    assert_same(evaluate(*network, pairs().replace(target_from_source=None)), prediction)


@pytest.mark.parametrize("compute", [ComputeConfig(kernels="plain"), ComputeConfig(kernels="fast", rows=7)], ids=["plain", "fast, rows"])
def test_kernels_and_chunks_of_rows_change_nothing(compute, network, prediction, batch, tiny_flags, x64):
    assert_same(evaluate(CMIGNet(tiny_flags(), compute), network[1], batch), prediction)


def test_the_pose_is_the_composition_of_the_steps(prediction, batch, x64):
    first, second = prediction.iterations
    assert_same(second.step.compose(first.step), prediction.target_from_source)
    assert_same(first.step.apply(first.source), second.source)
    keypoints = np.take_along_axis(batch.source, np.asarray(prediction.keypoints.source_index)[..., None], 1)
    np.testing.assert_array_equal(first.source, keypoints)


def test_correspondences_are_those_of_the_last_iteration(prediction):
    found, chosen, last = prediction.correspondences, prediction.keypoints, prediction.iterations[-1]
    expected = chosen.source_index, chosen.target_index, last.correspondence, last.weight
    for x, y in zip((found.source_index, found.target_index, found.partner, found.weight), expected, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("correspondence", ["hard", "soft"])
def test_correspondents_are_the_best_or_the_mean_under_the_softmax_of_the_clipped_matching(correspondence, tiny_flags, x64):
    rng = np.random.default_rng(0)
    source, target = (KeypointSet(points=rng.normal(size=(2, n, 3)), features=None) for n in (7, 9))
    match = Match(feature=10 * rng.normal(size=(2, 7, 9)), coordinate=10 * rng.normal(size=(2, 7, 9)), logit=rng.normal(size=(2, 7)))
    found = CMIGNet(tiny_flags(matching={"correspondence": correspondence}))._solve(match, source, target)
    total = np.clip(match.feature + match.coordinate, -20, 20)
    best = total.argmax(-1)
    weights = np.eye(9)[best] if correspondence == "hard" else np.exp(total) / np.exp(total).sum(-1, keepdims=True)
    np.testing.assert_array_equal(found.correspondence, best)
    np.testing.assert_allclose(found.corresponding, weights @ target.points, atol=1e-12)
    np.testing.assert_allclose(found.weight, credible_half(1 / (1 + np.exp(-match.logit))), atol=1e-12)
    pose = weighted_procrustes(source.points, found.corresponding, found.weight)
    assert_same(found.step, pose)


def test_sinkhorn_s_matching_gives_partners_by_its_rows_and_weights_by_their_sums(tiny_flags, x64):
    rng = np.random.default_rng(0)
    source, target = (KeypointSet(points=rng.normal(size=(2, n, 3)), features=None) for n in (7, 9))
    feature = 3 * rng.normal(size=(2, 7, 9))
    feature[:, 2] = -15  # a keypoint that is like none of the others
    match = Match(feature=feature, coordinate=np.zeros((2, 7, 9)), logit=np.full((2, 7), 2.0))
    found = CMIGNet(tiny_flags(matching={"correspondence": "sinkhorn"}))._solve(match, source, target)
    matching = np.exp(np.pad(feature, ((0, 0), (0, 1), (0, 1))))  # with the slack, plainly
    for _ in range(5):
        matching[:, :-1] /= matching[:, :-1].sum(axis=2, keepdims=True)
        matching[:, :, :-1] /= matching[:, :, :-1].sum(axis=1, keepdims=True)
    matching = matching[:, :-1, :-1]
    np.testing.assert_allclose(np.exp(found.log_matching), matching, atol=1e-12)
    np.testing.assert_allclose(found.corresponding, matching / matching.sum(-1, keepdims=True) @ target.points, atol=1e-12)
    np.testing.assert_allclose(found.weight, credible_half(matching.sum(-1) / (1 + np.exp(-2.0))), atol=1e-12)
    assert np.all(np.asarray(found.weight)[:, 2] == 0)


def test_an_overlap_score_weighs_the_correspondence_of_its_keypoint(tiny_flags, x64):
    rng = np.random.default_rng(0)
    overlap = rng.uniform(size=(2, 7))
    source = KeypointSet(points=rng.normal(size=(2, 7, 3)), features=None, overlap=overlap)
    target = KeypointSet(points=rng.normal(size=(2, 9, 3)), features=None)
    match = Match(feature=rng.normal(size=(2, 7, 9)), coordinate=None, logit=rng.normal(size=(2, 7)))
    found = CMIGNet(tiny_flags())._solve(match, source, target)
    np.testing.assert_allclose(found.weight, credible_half(overlap / (1 + np.exp(-match.logit))), atol=1e-12)


def test_overlap_scores_are_returned_and_used_as_probabilities(tiny_flags, pairs, random_variables, x64):
    batch = pairs(20, 24).replace(views=None)
    net = CMIGNet(tiny_flags(fusion={"image": "none"}, keypoints={"target": "overlap", "count": 12}))
    found = evaluate(net, random_variables(net, batch, train=False), batch)
    for scores, overlap in ((found.source_scores, found.source_overlap), (found.target_scores, found.target_overlap)):
        np.testing.assert_allclose(overlap, 1 / (1 + np.exp(-np.asarray(scores))), atol=1e-12)
    first = found.iterations[0]
    of_keypoints = np.take_along_axis(np.asarray(found.source_overlap), np.asarray(found.keypoints.source_index), 1)
    np.testing.assert_allclose(first.weight, credible_half(of_keypoints / (1 + np.exp(-np.asarray(first.logit)))), atol=1e-12)


@pytest.mark.parametrize("local", ["none", "pairs"])
def test_features_anew_are_those_of_the_source_as_it_was_moved(local, tiny_flags, pairs, random_variables, x64):
    flags = tiny_flags(fusion={"image": "none"}, keypoints={"select": "all"}, points={"local": local, "local_widths": (8,)})
    batch = pairs(20, 24).replace(views=None)
    unit = [x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (batch.source, batch.target)]
    batch = batch.replace(source_normals=unit[0], target_normals=unit[1])
    anew = CMIGNet(dataclasses.replace(flags, matching=dataclasses.replace(flags.matching, features="anew")))
    variables = random_variables(anew, batch, train=False)
    found, once = evaluate(anew, variables, batch), evaluate(CMIGNet(flags), variables, batch)
    assert_same(found.iterations[0], once.iterations[0])
    first = found.iterations[0].step
    turned = first.replace(t=np.zeros((2, 3)))
    # The second round alone: the network whose first round has the weights of the second, on the moved source.
    swapped = {kind: {**x, "heads_0": x["heads_1"]} if "heads_1" in x else x for kind, x in variables.items()}
    second = evaluate(CMIGNet(flags), swapped, batch.replace(source=first.apply(batch.source), source_normals=turned.apply(unit[0])))
    assert_same(second.iterations[0].match, found.iterations[1].match)
    assert_same(second.iterations[0].step, found.iterations[1].step)
    assert np.abs(found.iterations[1].match - once.iterations[1].match).max() > 1e-3


def test_keypoints_are_the_points_of_highest_score(prediction):
    for scores, index in (
        (prediction.source_scores, prediction.keypoints.source_index),
        (prediction.target_scores, prediction.keypoints.target_index),
    ):
        np.testing.assert_array_equal(index, np.argsort(-np.asarray(scores), axis=1)[:, :32])


def test_all_and_random_keypoints_need_no_scores(tiny_flags, pairs):
    everything, drawn = (CMIGNet(tiny_flags(keypoints={"select": select}))._keypoints for select in ("all", "random"))
    chosen = everything(pairs(), None, None, None)
    np.testing.assert_array_equal(chosen.source_index, [range(70)] * 2)
    np.testing.assert_array_equal(chosen.target_index, [range(90)] * 2)
    first, again, other = (drawn(pairs(), None, None, jax.random.key(key)) for key in (3, 3, 4))
    assert (len(set(np.asarray(first.source_index)[0])), len(set(np.asarray(first.target_index)[0]))) == (32, 32)
    np.testing.assert_array_equal(first.target_index, again.target_index)
    assert not np.array_equal(first.target_index, other.target_index)


@pytest.mark.parametrize("gradient", ["through", "stopped"])
def test_the_pose_passes_a_gradient_to_the_iteration_before_only_with_through(gradient, tiny_flags, pairs, random_variables):
    flags = tiny_flags(fusion={"points": "none", "image": "none"}, keypoints={"select": "all"}, pose={"gradient": gradient})
    net, batch = CMIGNet(flags), pairs(12, 12, dtype=np.float32).replace(views=None)
    variables = random_variables(net, batch, dtype=np.float32, train=False)

    def second_source(params):
        return jnp.sum(net.apply({**variables, "params": params}, batch, train=False).iterations[1].source ** 3)

    slope = jax.jit(jax.grad(second_source))(variables["params"])["heads_0"]["credibility"]
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(slope))
    assert any(np.any(g != 0) for g in jax.tree.leaves(slope)) == (gradient == "through")


@pytest.mark.parametrize("K", [6, 7])
def test_weights_sum_to_one_over_the_half_from_the_lower_median_up(K):
    score = np.random.default_rng(0).uniform(0.1, 1, (3, K)).astype(np.float32)
    weight = np.asarray(credible_half(score))
    median = np.sort(score, axis=1)[:, [(K - 1) // 2]]
    np.testing.assert_array_equal(weight > 0, score >= median)
    np.testing.assert_array_equal((weight > 0).sum(1), K // 2 + 1)
    np.testing.assert_allclose(weight.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(weight, np.where(weight > 0, score, 0) / np.where(weight > 0, score, 0).sum(1, keepdims=True), atol=1e-6)
    np.testing.assert_allclose(credible_half(np.full((1, K), 0.4, np.float32)), 1 / K, rtol=1e-6)
