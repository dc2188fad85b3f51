"""The draw of keypoints in training, and the choice in evaluation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.models.cmignet.keypoints import SignificanceScore, draw_for_training, pair_in_order, random_points, true_correspondents
from cmig_jax.transform import RigidTransform

LABEL = (np.arange(40) < 15).astype(np.float32)[None].repeat(3, 0)
draw = jax.jit(draw_for_training, static_argnums=2)


def test_halves_are_drawn_without_replacement():
    for half in np.split(np.asarray(draw(jax.random.key(0), LABEL, 20)), 2, axis=1):
        assert all(len(set(row)) == 10 for row in half)


def test_one_half_has_a_true_correspondent_and_the_other_has_none():
    drawn = np.asarray(draw(jax.random.key(0), LABEL, 20))
    labels = np.take_along_axis(LABEL, drawn, axis=1)
    np.testing.assert_array_equal(labels, np.arange(20)[None].repeat(3, 0) < 10)


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_a_half_that_runs_out_of_its_kind_fills_up(value):
    drawn = np.asarray(draw(jax.random.key(1), np.full((3, 40), value, np.float32), 80))
    np.testing.assert_array_equal(np.sort(drawn[:, :40], axis=1), np.arange(40)[None].repeat(3, 0))
    few = np.zeros((3, 40), np.float32)
    few[:, :4] = 1
    drawn = np.asarray(draw(jax.random.key(1), few, 20))
    assert all({0, 1, 2, 3} <= set(row[:10]) for row in drawn)


def test_an_odd_count_gives_one_more_point_without_a_correspondent():
    drawn = np.asarray(draw(jax.random.key(0), LABEL, 7))
    np.testing.assert_array_equal(np.take_along_axis(LABEL, drawn, axis=1).sum(1), [3, 3, 3])


def test_the_draw_is_a_function_of_the_key_and_differs_between_pairs():
    np.testing.assert_array_equal(draw(jax.random.key(0), LABEL, 20), draw(jax.random.key(0), LABEL, 20))
    drawn = np.asarray(draw(jax.random.key(0), LABEL, 20))
    assert not np.array_equal(drawn, draw(jax.random.key(1), LABEL, 20))
    assert not np.array_equal(drawn[0], drawn[1])


def test_labelled_points_are_drawn_equally_often():
    keys = jax.random.split(jax.random.key(2), 400)
    drawn = np.asarray(jax.jit(jax.vmap(lambda k: draw_for_training(k, jnp.asarray(LABEL), 10)))(keys))[..., :5]
    share = np.bincount(drawn.ravel(), minlength=40)[:15] / (400 * 3 * 5)
    np.testing.assert_allclose(share, 1 / 15, atol=0.02)


def test_random_points_do_not_repeat_and_depend_on_the_key_alone():
    drawn = np.asarray(random_points(jax.random.key(0), 3, 20, 15))
    assert len(set(drawn[0])) == 15
    np.testing.assert_array_equal(drawn, random_points(jax.random.key(0), 3, 20, 15))
    np.testing.assert_array_equal(drawn[0], drawn[2])


def test_true_correspondents_undo_pose_and_order_and_label_by_the_threshold():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(2, 30, 3)).astype(np.float32)
    pose = RigidTransform(R=Rotation.random(2, rng=rng).as_matrix().astype(np.float32), t=rng.normal(size=(2, 3)).astype(np.float32))
    order = rng.permutation(30)[:20]
    target = np.asarray(pose.apply(source))[:, order]
    target[:, 10:, 0] += 0.03
    index, label = true_correspondents(source, target, pose, 0.02)
    assert label.dtype == source.dtype
    for position, point in enumerate(order[:10]):
        np.testing.assert_array_equal(index[:, point], position)
    np.testing.assert_array_equal(label[:, order[:10]], 1)
    np.testing.assert_array_equal(label[:, order[10:]], 0)
    chunked = true_correspondents(source, target, pose, 0.02, rows=7)
    np.testing.assert_array_equal(chunked[0], index)
    np.testing.assert_array_equal(chunked[1], label)


def test_target_keypoints_are_the_correspondents_in_the_same_order():
    rng = np.random.default_rng(1)
    chosen, correspondent, label = rng.integers(0, 9, (2, 5)), rng.integers(0, 8, (2, 9)), rng.integers(0, 2, (2, 9)).astype(np.float32)
    keypoints = pair_in_order(chosen, correspondent, label)
    np.testing.assert_array_equal(keypoints.target_index, np.take_along_axis(correspondent, chosen, 1))
    np.testing.assert_array_equal(keypoints.match_label, np.take_along_axis(label, chosen, 1))
    np.testing.assert_array_equal(keypoints.match_index, [range(5)] * 2)


def test_a_score_is_the_perceptron_of_own_features_beside_the_pooled_vector(random_variables):
    rng = np.random.default_rng(2)
    points, pooled = rng.normal(size=(2, 6, 8)).astype(np.float32), rng.normal(size=(2, 8)).astype(np.float32)
    score = SignificanceScore(dim=8)
    variables = random_variables(score, points, pooled, dtype=np.float32)
    p = variables["params"]
    x = np.concatenate([points, pooled[:, None].repeat(6, 1)], -1) @ p["kernel"] + p["bias"]
    for name in ("layer_0", "layer_1", "layer_2"):
        x = np.maximum(x, 0) @ p["rest"][name]["kernel"] + p["rest"][name]["bias"]
    np.testing.assert_allclose(jax.jit(score.apply)(variables, points, pooled), x[..., 0], atol=1e-5)
    squashed = jax.jit(score.clone(activation="sigmoid").apply)(variables, points, pooled)
    np.testing.assert_allclose(squashed, 1 / (1 + np.exp(-x[..., 0])), atol=1e-5)
