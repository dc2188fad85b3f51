"""The network as a function: what its results may depend on, and that every flag gives one."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import (
    ComputeConfig,
    Config,
    DataConfig,
    FusionConfig,
    ImageConfig,
    KeypointsConfig,
    LossConfig,
    MatchingConfig,
    ModelConfig,
    PointsConfig,
    PoseConfig,
    ViewsConfig,
)
from cmig_jax.nn.build import build
from cmig_jax.nn.cmignet import credible_half
from cmig_jax.structs import Batch, RigidTransform


def tiny(head="cmignet", select="predicted", score_from="own", activation="linear", precision="float32", rows=0, loss="off", **parts):
    """Describe a network of a few channels; flags of fusion, matching and pose come in `parts`."""
    return Config(
        data=DataConfig(points=100),
        views=ViewsConfig(count=2, layout="ring", size=16),
        model=ModelConfig(
            points=PointsConfig(k=4, widths=(8, 8), dim=16),
            image=ImageConfig(widths=(4, 16), blocks=(1, 1)),
            fusion=FusionConfig(heads=2, feed_forward=16, **parts.get("fusion", {})),
            keypoints=KeypointsConfig(count=32, select=select, score_from=score_from, activation=activation),
            matching=MatchingConfig(head=head, iterations=2, feature_widths=(8, 8), coordinate_widths=(8,), **parts.get("matching", {})),
            pose=PoseConfig(**parts.get("pose", {})),
        ),
        loss=LossConfig(cross_modal=loss),
        compute=ComputeConfig(precision=precision, rows=rows, recompute=parts.get("recompute", "off")),
    )


def pairs(N=70, M=90, sets=1, dtype=np.float64):
    rng = np.random.default_rng(0)
    pose = RigidTransform(R=Rotation.random(2, rng=rng).as_matrix().astype(dtype), t=rng.normal(size=(2, 3)).astype(dtype))
    return Batch(
        source=rng.normal(size=(2, N, 3)).astype(dtype),
        target=rng.normal(size=(2, M, 3)).astype(dtype),
        views=rng.integers(0, 256, (2, sets, 2, 16, 16, 1), dtype=np.uint8),
        target_from_source=pose,
    )


def shapes(net, batch, train):
    """Trace the network: the variables it makes and its prediction."""

    def run(key, batch):
        return net.init_with_output(key, batch, train=train, key=key)

    prediction, variables = jax.eval_shape(run, jax.random.key(0), batch)
    return variables, prediction


@functools.partial(jax.jit, static_argnums=0)
def evaluate(net, variables, batch):
    return net.apply(variables, batch, train=False)


@pytest.fixture(scope="module")
def network(random_like):
    """Give the paper's network, tiny, with variables in float64."""
    net = build(tiny())
    return net, random_like(shapes(net, pairs(), False)[0], seed=24, dtype=np.float64)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def prediction(network):
    """Predict two pairs of 70 and 90 points."""
    with jax.enable_x64(True):
        return evaluate(*network, pairs())


def assert_same(a, b, atol=1e-9):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


def test_the_cases_below_have_a_pose_to_speak_of(prediction):
    assert prediction.target_from_source.R.dtype == jnp.float64
    for iteration in prediction.iterations:
        used = np.where(np.asarray(iteration.weight) > 0, iteration.correspondence, -1)
        assert all(len(set(row)) > 4 for row in used)
    assert all(
        len(set(row)) == scores.shape[1] for scores in (prediction.source_scores, prediction.target_scores) for row in np.asarray(scores)
    )


def test_clouds_of_different_size_give_rotations(prediction):
    R = np.asarray(prediction.target_from_source.R)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.eye(3)[None].repeat(2, 0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)
    assert (prediction.source_scores.shape, prediction.target_scores.shape) == ((2, 70), (2, 90))


def test_the_order_of_points_permutes_the_scores_and_leaves_the_pose(network, prediction, x64):
    batch, rng = pairs(), np.random.default_rng(1)
    order, other = rng.permutation(70), rng.permutation(90)
    permuted = evaluate(*network, batch.replace(source=batch.source[:, order], target=batch.target[:, other]))
    np.testing.assert_allclose(permuted.source_scores, prediction.source_scores[:, order], atol=1e-9)
    np.testing.assert_allclose(permuted.target_scores, prediction.target_scores[:, other], atol=1e-9)
    assert_same(permuted.target_from_source, prediction.target_from_source)


def test_a_batch_of_two_is_two_batches_of_one(network, prediction, x64):
    for i in range(2):
        single = evaluate(*network, jax.tree.map(lambda x, i=i: x[i : i + 1], pairs()))
        assert_same(single, jax.tree.map(lambda x, i=i: x[i : i + 1], prediction))


def test_evaluation_does_not_read_the_true_pose(network, prediction, x64):
    assert_same(evaluate(*network, pairs().replace(target_from_source=None)), prediction)


def test_chunks_of_rows_change_nothing(network, prediction, x64):
    assert_same(evaluate(build(tiny(rows=13)), network[1], pairs()), prediction)


def test_the_pose_is_the_composition_of_the_steps(prediction):
    first, second = prediction.iterations
    with jax.enable_x64(True):
        assert_same(second.step.compose(first.step), prediction.target_from_source)
        assert_same(first.step.apply(first.source), second.source)
        keypoints = np.take_along_axis(pairs().source, np.asarray(prediction.keypoints.source_index)[..., None], 1)
        np.testing.assert_array_equal(first.source, keypoints)


def test_soft_partners_are_means_under_the_softmax_of_the_matching(network, prediction, x64):
    soft = evaluate(dataclasses.replace(network[0], correspondence="soft"), network[1], pairs())
    first, hard = soft.iterations[0], prediction.iterations[0]
    np.testing.assert_array_equal(first.correspondence, hard.correspondence)
    targets = np.take_along_axis(pairs().target, np.asarray(soft.keypoints.target_index)[..., None], 1)
    likelihood = np.exp(first.match) / np.exp(first.match).sum(-1, keepdims=True)
    np.testing.assert_allclose(first.corresponding, likelihood @ targets, atol=1e-12)
    assert np.abs(first.corresponding - hard.corresponding).max() > 0.1


def test_keypoints_are_the_points_of_highest_score(prediction):
    for scores, index in (
        (prediction.source_scores, prediction.keypoints.source_index),
        (prediction.target_scores, prediction.keypoints.target_index),
    ):
        np.testing.assert_array_equal(index, np.argsort(-np.asarray(scores), axis=1)[:, :32])


VARIANTS = {
    "paper": {},
    "released": {"fusion": {"image": "transformer"}, "score_from": "other", "activation": "sigmoid", "pose": {"centroid": "unweighted"}},
    "views": {"fusion": {"image": "views"}, "loss": "nt-xent"},
    "no image, but its loss": {"fusion": {"image": "none"}, "loss": "paper"},
    "no image": {"fusion": {"image": "none"}},
    "no transformer": {"fusion": {"points": "none"}},
    "no fusion": {"fusion": {"points": "none", "image": "none"}},
    "idam": {"head": "idam"},
    "idam in rows": {"head": "idam", "rows": 13},
    "pcrnet": {"head": "pcrnet"},
    "random": {"select": "random"},
    "all": {"select": "all"},
    "all in rows": {"select": "all", "rows": 13},
    "soft": {"matching": {"correspondence": "soft"}},
    "through": {"pose": {"gradient": "through"}},
    "bfloat16": {"precision": "bfloat16", "fusion": {"image": "views"}},
    "bfloat16 idam": {"precision": "bfloat16", "head": "idam", "fusion": {"image": "transformer"}},
    "bfloat16 pcrnet": {"precision": "bfloat16", "head": "pcrnet", "fusion": {"points": "none"}},
}


@pytest.mark.parametrize("name", VARIANTS)
def test_every_variant_trains_and_evaluates_in_float32(name):
    flags = VARIANTS[name]
    net, batch = build(tiny(**flags)), pairs(60, 60 if "score_from" in flags else 50, sets=2, dtype=np.float32)
    variables, trained = shapes(net, batch, True)
    evaluated = jax.eval_shape(lambda v: net.apply(v, batch, train=False), variables)
    K = [32, 32] if flags.get("select") != "all" else [60, 50]
    for prediction in (trained, evaluated):
        numbers = [x.dtype for x in jax.tree.leaves(prediction) if jnp.issubdtype(x.dtype, jnp.floating)]
        assert set(numbers) == {jnp.dtype("float32")}
        assert (prediction.target_from_source.R.shape, prediction.target_from_source.t.shape) == ((2, 3, 3), (2, 3))
        assert prediction.keypoints.source_index.shape == (2, K[0])
        assert len(prediction.iterations) == 2
        assert (prediction.source_scores is None) == (flags.get("select", "predicted") != "predicted")
        if flags.get("head") != "pcrnet":
            assert prediction.iterations[1].match.shape == (2, K[0], K[0] if prediction is trained and K[0] == 32 else K[1])
    assert trained.keypoints.match_index.shape == (2, K[0])
    assert evaluated.keypoints.match_index is None
    reads = flags.get("fusion", {}).get("image") != "none"
    assert [trained.image_features is not None, evaluated.image_features is not None] == [reads or "loss" in flags, reads]
    assert {x.dtype for x in jax.tree.leaves(variables)} == {jnp.dtype("float32")}, "parameters and statistics stay in float32"


def test_tied_image_fusion_has_no_weights_of_its_own():
    tied, none = (shapes(build(tiny(fusion={"image": image})), pairs(), False)[0]["params"] for image in ("transformer", "none"))
    assert set(tied) - set(none) == {"views"}


def test_bfloat16_gives_a_rotation_in_float32(random_like):
    net, batch = build(tiny(precision="bfloat16", fusion={"image": "views"})), pairs(40, 40, dtype=np.float32)
    pose = evaluate(net, random_like(shapes(net, batch, False)[0]), batch).target_from_source
    assert pose.R.dtype == pose.t.dtype == jnp.float32
    np.testing.assert_allclose(pose.R @ pose.R.swapaxes(1, 2), np.eye(3)[None].repeat(2, 0), atol=1e-5)


@pytest.mark.parametrize("gradient", ["through", "stopped"])
def test_a_pose_gradient_reaches_the_logits_of_the_round_before_only_if_let_through(gradient, random_like):
    net = build(tiny(fusion={"points": "none", "image": "none"}, select="all", pose={"gradient": gradient}))
    batch = pairs(12, 12, dtype=np.float32).replace(views=None)
    variables = random_like(shapes(net, batch, False)[0])

    def second_source(params):
        return jnp.sum(net.apply({**variables, "params": params}, batch, train=False).iterations[1].source ** 3)

    slope = jax.jit(jax.grad(second_source))(variables["params"])["heads_0"]["credibility"]
    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(slope))
    assert any(np.any(g != 0) for g in jax.tree.leaves(slope)) == (gradient == "through")


def test_all_and_random_choose_without_scores():
    everything, drawn = (build(tiny(select=select)) for select in ("all", "random"))
    batch, key = pairs(), jax.random.key(3)
    chosen = everything._keypoints(batch, None, None, None)
    np.testing.assert_array_equal(chosen.source_index, [range(70)] * 2)
    np.testing.assert_array_equal(chosen.target_index, [range(90)] * 2)
    chosen = drawn._keypoints(batch, None, None, key)
    assert (len(set(np.asarray(chosen.source_index)[0])), len(set(np.asarray(chosen.target_index)[0]))) == (32, 32)
    np.testing.assert_array_equal(chosen.target_index, drawn._keypoints(batch, None, None, key).target_index)
    assert not np.array_equal(chosen.target_index, drawn._keypoints(batch, None, None, jax.random.key(4)).target_index)


def test_scores_of_the_other_cloud_need_clouds_of_equal_size():
    with pytest.raises(ValueError, match=r"score_from=other .*expected N = M, got 70 and 90 points"):
        shapes(build(tiny(score_from="other")), pairs(), False)


@pytest.mark.parametrize(
    ("config", "batch", "message"),
    [
        (tiny(), pairs(31, 90), "at least 32 points .*got 31 and 90"),
        (tiny(select="all"), pairs(90, 3), "at least 4 points .*got 90 and 3"),
        (tiny(), pairs().replace(views=None), r"expected batch\.views, got None"),
        (tiny(), pairs().replace(target_from_source=None), r"expected batch\.target_from_source, got None"),
    ],
)
def test_what_the_network_cannot_use_is_named(config, batch, message):
    with pytest.raises(ValueError, match=message):
        shapes(build(config), batch, True)


def test_training_needs_randomness_or_its_result():
    net, batch = build(tiny()), pairs()
    with pytest.raises(ValueError, match="expected a key or source_index"):
        jax.eval_shape(lambda b: net.init(jax.random.key(0), b, train=True), batch)
    index = np.arange(64).reshape(2, 32)
    given = jax.eval_shape(lambda b: net.init_with_output(jax.random.key(0), b, train=True, source_index=index)[0], batch)
    assert given.keypoints.source_index.shape == (2, 32)


@pytest.mark.parametrize("K", [6, 7])
def test_weights_sum_to_one_over_the_half_from_the_lower_median_up(K):
    score = np.random.default_rng(0).uniform(0.1, 1, (3, K)).astype(np.float32)
    weight = np.asarray(credible_half(score))
    median = np.sort(score, axis=1)[:, [(K - 1) // 2]]
    np.testing.assert_array_equal(weight > 0, score >= median)
    np.testing.assert_array_equal((weight > 0).sum(1), K // 2 + 1)
    np.testing.assert_allclose(weight.sum(1), 1, atol=1e-6)
    np.testing.assert_allclose(weight, np.where(weight > 0, score, 0) / np.where(weight > 0, score, 0).sum(1, keepdims=True), atol=1e-6)


def test_equal_scores_weigh_equally():
    np.testing.assert_allclose(credible_half(np.full((1, 8), 0.4, np.float32)), 1 / 8, rtol=1e-6)


def test_the_threshold_of_the_labels_is_the_losses():
    config = tiny()
    loose = dataclasses.replace(config, loss=dataclasses.replace(config.loss, match_threshold=0.2))
    assert build(loose).match_threshold == 0.2


def test_recomputing_keeps_less_for_the_derivative_of_the_same_variables():
    batch, parts = pairs(70, 70, dtype=np.float32), {"loss": "nt-xent", "fusion": {"image": "transformer"}}

    def kept(recompute):
        net = build(tiny(recompute=recompute, **parts))
        variables = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes(net, batch, True)[0])

        def loss(params):
            prediction, _ = net.apply({**variables, "params": params}, batch, train=True, key=jax.random.key(1), mutable=["batch_stats"])
            return sum(jnp.sum(i.match) + jnp.sum(i.logit) for i in prediction.iterations)

        pull = jax.eval_shape(lambda params: jax.vjp(loss, params)[1], variables["params"])
        return jax.tree.structure(variables), sum(x.size for x in jax.tree.leaves(pull))

    (off, more), (on, less) = kept("off"), kept("on")
    assert off == on
    assert less < more / 2
