"""The five losses against their formulas, written out in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import log_softmax

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.sinkhorn import log_sinkhorn_with_slack
from cmig_jax.models.cmignet import losses as functions
from cmig_jax.models.cmignet.flags import CMIGNetFlags, KeypointsFlags, LossFlags
from cmig_jax.models.cmignet.losses import credibility, cross_modal, mask, matching, overlap
from cmig_jax.models.cmignet.prediction import CMIGNetPrediction, Iteration, Keypoints
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

B, N, M, K, C = 3, 12, 14, 6, 5
MARGINS = (2.0, 3.0)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def losses(prediction, batch, rows=0, **flags):
    flags, compute = CMIGNetFlags(loss=LossFlags(**flags)), ComputeConfig(rows=rows)
    return jax.jit(lambda prediction, batch: functions.losses(prediction, batch, flags, compute))(prediction, batch)


def case(label=None, seed=0):
    """Draw a batch whose first points overlap, and a prediction of one round for it."""
    rng = np.random.default_rng(seed)
    pose = RigidTransform(R=Rotation.random(B, rng=rng).as_matrix(), t=rng.normal(size=(B, 3)))
    source = rng.normal(size=(B, N, 3))
    target = rng.normal(size=(B, M, 3))
    target[:, :5] = source[:, :5] @ pose.R.swapaxes(1, 2) + pose.t[:, None]
    index = np.stack([rng.permutation(N)[:K] for _ in range(B)]), np.stack([rng.permutation(M)[:K] for _ in range(B)])
    correspondence = rng.integers(0, K, (B, K))
    correspondence[:, :2] = [0, 1]
    corresponding = np.take_along_axis(target, np.take_along_axis(index[1], correspondence, 1)[..., None], 1)
    true = np.take_along_axis(source, index[0][..., None], 1) @ pose.R.swapaxes(1, 2) + pose.t[:, None]
    corresponding[:, 2] = true[:, 2] + 0.02
    corresponding[:, 3] = true[:, 3] + 0.04
    label = (rng.uniform(size=(B, K)) < 0.5).astype(float) if label is None else np.full((B, K), label)
    iteration = Iteration(
        source=np.take_along_axis(source, index[0][..., None], 1),
        step=pose,
        match=rng.normal(size=(B, K, K)),
        logit=3 * rng.normal(size=(B, K)),
        correspondence=correspondence,
        corresponding=corresponding,
    )
    prediction = CMIGNetPrediction(
        source_features=rng.normal(size=(B, N, C)),
        target_features=rng.normal(size=(B, M, C)),
        image_features=rng.normal(size=(B, 2, C)),
        source_fused=np.zeros((B, N, C)),
        target_fused=np.zeros((B, M, C)),
        source_scores=rng.normal(size=(B, N)),
        target_scores=rng.normal(size=(B, M)),
        keypoints=Keypoints(source_index=index[0], target_index=index[1], match_index=np.arange(K)[None].repeat(B, 0), match_label=label),
        iterations=(iteration,),
        target_from_source=pose,
    )
    return prediction, Batch(source=source, target=target, target_from_source=pose)


@pytest.mark.parametrize("include_positive", [False, True])
def test_cross_modal_contrasts_each_vector_with_all_others(include_positive):
    rng, tau = np.random.default_rng(0), 0.1
    P, I = rng.normal(size=(2, B, C))  # noqa: E741
    unit = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in (P, I)]

    def term(a, b, i):
        others = [k for k in range(B) if k != i]
        positive = np.exp(a[i] @ b[i] / tau)
        negative = sum(np.exp(a[i] @ a[k] / tau) + np.exp(a[i] @ b[k] / tau) for k in others)
        return -np.log(positive / (negative + positive * include_positive))

    expected = sum(term(*unit, i) + term(*unit[::-1], i) for i in range(B)) / (2 * B)
    np.testing.assert_allclose(cross_modal(P, I, tau, include_positive), expected, rtol=1e-12)


def by_hand_overlap(f, g, x, y, active):
    total = 0.0
    distance = np.sqrt(np.sum((f[:, None] - g[None]) ** 2, -1) + 1e-7)
    for chosen, term in (
        (np.outer(x, y), np.maximum(distance - MARGINS[0], 0) ** 2),
        (np.outer(x, ~y), np.maximum(MARGINS[1] - distance, 0) ** 2),
        (np.outer(~x, y), np.maximum(MARGINS[1] - distance, 0) ** 2),
    ):
        count = np.sum(chosen & (term > 0)) if active else np.sum(chosen)
        total += np.sum(term[chosen]) / count if count else 0
    return total


@pytest.mark.parametrize("active", [False, True])
def test_overlap_pulls_overlapping_features_together_and_pushes_others_apart(active):
    rng = np.random.default_rng(1)
    f, g, x, y = rng.normal(size=(N, C)), rng.normal(size=(M, C)), np.arange(N) < 5, np.arange(M) % 3 == 0
    expected = by_hand_overlap(f, g, x, y, active)
    assert expected > 0
    np.testing.assert_allclose(overlap(f, g, x, y, MARGINS, active), expected, rtol=1e-10)


@pytest.mark.parametrize("active", [False, True])
@pytest.mark.parametrize("overlaps", [False, True])
def test_overlap_without_members_or_active_terms_is_zero_with_a_finite_gradient(active, overlaps):
    features = np.ones((N, C))

    def value(f, g):
        return overlap(f, g, jnp.full(N, overlaps), jnp.full(N, overlaps), (70.0, 3.0), active)

    loss, gradients = jax.jit(jax.value_and_grad(value, argnums=(0, 1)))(features, features)
    assert loss == 0
    assert all(np.all(np.isfinite(g)) for g in gradients)


def test_a_point_overlaps_where_the_true_pose_brings_it_onto_the_other_cloud():
    prediction, batch = case()
    features = zip(prediction.source_features, prediction.target_features, strict=True)
    expected = np.mean([by_hand_overlap(f, g, np.arange(N) < 5, np.arange(M) < 5, False) for f, g in features])
    for rows in (0, 5):
        found = losses(prediction, batch, rows, margins=MARGINS, cross_modal="off")["overlap"]
        np.testing.assert_allclose(found, expected, rtol=1e-10)


def test_mask_regresses_on_the_negative_entropy_of_rows_and_columns():
    prediction, _ = case()
    expected = 0.0
    for scores, index, axis in (
        (prediction.source_scores, prediction.keypoints.source_index, 2),
        (prediction.target_scores, prediction.keypoints.target_index, 1),
    ):
        log_p = log_softmax(prediction.iterations[0].match, axis=axis)
        negative_entropy = np.sum(np.exp(log_p) * log_p, axis=axis)
        expected += 0.5 * np.mean((np.take_along_axis(scores, index, 1) - negative_entropy) ** 2)
    np.testing.assert_allclose(mask(prediction), expected, rtol=1e-12)


def test_mask_has_a_gradient_for_the_scores_and_none_for_the_matching():
    prediction, _ = case()

    def value(scores, match):
        first = prediction.iterations[0].replace(match=match)
        return mask(prediction.replace(source_scores=scores, iterations=(first,)))

    of_scores, of_match = jax.jit(jax.grad(value, argnums=(0, 1)))(prediction.source_scores, prediction.iterations[0].match)
    assert np.any(of_scores != 0)
    np.testing.assert_array_equal(of_match, 0)


@pytest.mark.parametrize("mean", ["all", "positive"])
def test_matching_is_the_likelihood_of_the_true_correspondents(mean):
    prediction, _ = case()
    label, log_p = prediction.keypoints.match_label, log_softmax(prediction.iterations[0].match, axis=2)
    index = np.random.default_rng(3).integers(0, K, (B, K))
    prediction = prediction.replace(keypoints=prediction.keypoints.replace(match_index=index))
    total = -sum(label[b, i] * log_p[b, i, index[b, i]] for b in range(B) for i in range(K))
    count = B * K if mean == "all" else label.sum()
    value = matching(prediction, prediction.iterations[0], LossFlags(match_mean=mean))
    np.testing.assert_allclose(value, total / count, rtol=1e-12)


@pytest.mark.parametrize("mean", ["all", "positive"])
def test_matching_without_a_positive_label_is_zero_with_a_finite_gradient(mean):
    prediction, _ = case(label=0.0)

    def value(match):
        return matching(prediction, prediction.iterations[0].replace(match=match), LossFlags(match_mean=mean))

    loss, gradient = jax.jit(jax.value_and_grad(value))(prediction.iterations[0].match)
    assert loss == 0
    np.testing.assert_array_equal(gradient, 0)


def test_sinkhorn_s_matching_is_the_likelihood_of_partners_and_of_having_none():
    prediction, _ = case()
    label, log_matching = prediction.keypoints.match_label, np.random.default_rng(4).normal(size=(B, K, K + 1))
    iteration = prediction.iterations[0].replace(log_matching=log_matching[..., :-1], log_slack=log_matching[..., -1])
    expected = -np.where(label > 0, np.diagonal(log_matching[..., :-1], axis1=1, axis2=2), log_matching[..., -1]).mean()
    np.testing.assert_allclose(matching(prediction, iteration, LossFlags(match_mean="positive")), expected, rtol=1e-9)


def test_a_sure_and_wrong_matching_of_a_keypoint_without_partner_is_corrected():
    prediction, _ = case(label=0.0)
    sure = 15.0 * np.eye(K)[None].repeat(B, 0)

    def loss(affinity):
        log_matching, log_slack = log_sinkhorn_with_slack(affinity, 5)
        return matching(prediction, prediction.iterations[0].replace(log_matching=log_matching, log_slack=log_slack), LossFlags())

    value, gradient = jax.value_and_grad(loss)(sure)
    assert value > 5
    assert np.all(np.diagonal(gradient, axis1=1, axis2=2) > 0.01)


def test_overlap_scores_learn_which_points_have_a_partner():
    prediction, batch = case()
    flags = CMIGNetFlags(keypoints=KeypointsFlags(target="overlap"), loss=LossFlags(overlap=False, cross_modal="off"))
    moved = batch.source @ batch.target_from_source.R.swapaxes(1, 2) + batch.target_from_source.t[:, None]
    gaps = np.linalg.norm(moved[:, :, None] - batch.target[:, None], axis=-1)
    expected = 0.0
    for scores, axis in ((prediction.source_scores, 2), (prediction.target_scores, 1)):
        partner = gaps.min(axis=axis) < 0.05
        assert partner.sum() == 5 * B
        expected += 0.5 * np.mean(np.logaddexp(0, np.where(partner, -scores, scores)))
    terms = functions.losses(prediction, batch, flags, ComputeConfig())
    np.testing.assert_allclose(terms["mask"], expected, rtol=1e-9)


@pytest.mark.parametrize(("kind", "threshold"), [("index", 0.05), ("distance", 0.05), ("distance", 0.1)])
def test_credibility_is_the_cross_entropy_of_being_right(kind, threshold):
    prediction, batch = case()
    iteration, pose = prediction.iterations[0], batch.target_from_source
    moved = iteration.source @ pose.R.swapaxes(1, 2) + pose.t[:, None]
    near = np.linalg.norm(moved - iteration.corresponding, axis=-1) < threshold
    assert near.sum() >= (B if threshold == 0.05 else 2 * B)
    right = iteration.correspondence == np.arange(K) if kind == "index" else near
    s = 1 / (1 + np.exp(-iteration.logit))
    expected = -np.mean(np.where(right, np.log(s), np.log(1 - s)))
    config = LossFlags(credibility_label=kind, match_threshold=threshold)
    np.testing.assert_allclose(credibility(prediction, iteration, batch.source, pose, config), expected, rtol=1e-12)


def test_terms_follow_the_flags_and_the_head():
    prediction, batch = case()
    names = {"cross_modal", "overlap", "mask", "matching_0", "credibility_0", "matching_1", "credibility_1"}
    twice = prediction.replace(iterations=prediction.iterations * 2)

    def terms(prediction, **flags):
        found = jax.eval_shape(lambda: losses(prediction, batch, **flags))
        assert {(x.shape, x.dtype) for x in found.values()} == {((), jnp.dtype("float64"))}
        return set(found)

    assert terms(twice) == names
    assert terms(twice, cross_modal="off", overlap=False) == names - {"cross_modal", "overlap"}
    assert terms(twice.replace(source_scores=None, target_scores=None)) == names - {"mask"}
    regressed = Iteration(source=prediction.iterations[0].source, step=prediction.iterations[0].step)
    assert terms(prediction.replace(iterations=(regressed,))) == {"cross_modal", "overlap", "pose_0"}


def test_cross_modal_of_the_batch_averages_pooled_clouds_and_view_sets():
    prediction, batch = case()
    points = 0.5 * (prediction.source_features.max(1) + prediction.target_features.max(1))
    expected = cross_modal(points, prediction.image_features.mean(1), 0.1, False)
    np.testing.assert_allclose(losses(prediction, batch, overlap=False)["cross_modal"], expected, rtol=1e-12)


def test_the_pose_loss_is_the_mean_distance_from_the_true_pose():
    prediction, batch = case()
    pose = batch.target_from_source
    for offset, expected in (([0.0, 0.0, 0.0], 0.0), ([0.3, 0.0, 0.4], 0.5)):
        regressed = Iteration(source=prediction.iterations[0].source, step=pose.replace(t=pose.t + np.array(offset)))
        value = losses(prediction.replace(iterations=(regressed,)), batch, overlap=False, cross_modal="off")["pose_0"]
        np.testing.assert_allclose(value, expected, atol=1e-5)


@pytest.mark.parametrize("value", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["paper", "nt-xent"])
def test_gradients_are_finite_at_features_that_are_all_equal_or_zero(value, kind):
    prediction, batch = case()

    def total(source, target, images):
        alike = prediction.replace(source_features=source, target_features=target, image_features=images)
        return sum(losses(alike, batch, cross_modal=kind).values())

    features = (np.full((B, N, C), value), np.full((B, M, C), value), np.full((B, 2, C), value))
    loss, gradients = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))(*features)
    assert np.isfinite(loss)
    assert all(np.all(np.isfinite(g)) for g in gradients)
