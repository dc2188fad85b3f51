"""OMNet: what its masks do, and the labels that they are trained with."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import predict
from cmig_jax.models.omnet.network import OMNET, OMNetFlags, Stage, losses, near_pairs, overlap_labels, overlapping
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

FLAGS = OMNetFlags(iterations=3, regression_widths=(8,), fusion_widths=(12,), local_widths=(8,), global_widths=(16,), decoder_widths=(8,))

evaluate = jax.jit(predict, static_argnums=0)


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def batch():
    """Return two pairs: the target holds the last 20 points of the source, moved, and 20 points far away from it."""
    rng = np.random.default_rng(0)
    pose = RigidTransform(R=Rotation.random(2, rng=rng).as_matrix(), t=rng.normal(size=(2, 3)))
    source = rng.normal(size=(2, 30, 3))
    target = pose.apply(np.concatenate([source[:, 10:], rng.normal(size=(2, 20, 3)) + 20], axis=1))
    with jax.enable_x64(True):
        return jax.tree.map(jnp.asarray, Batch(source=source, target=target, target_from_source=pose))


@pytest.fixture(scope="module")
def network(batch, random_variables):
    module = OMNET.build(FLAGS, ComputeConfig())
    with jax.enable_x64(True):
        return module, random_variables(module, batch, train=False, seed=3)


def biased(variables, stage, bias):
    """Return the variables with a stage's class bias, so that it keeps all points or none."""
    decoder = variables["params"][stage]["decoder"]
    changed = {**decoder, "logits": {**decoder["logits"], "bias": jnp.asarray([0.0, bias])}}
    return {**variables, "params": {**variables["params"], stage: {**variables["params"][stage], "decoder": changed}}}


def test_masked_points_have_no_influence_in_evaluation(network, batch):
    _, variables = network
    masks = (jnp.arange(30) < 20).astype(jnp.float64)[None].repeat(2, 0), jnp.ones((2, 40))
    stage = {kind: tree["stages_2"] for kind, tree in variables.items()}
    apply = jax.jit(lambda source: Stage(FLAGS).apply(stage, source, batch.target, masks, train=False))
    moved = batch.source.at[:, 20:].add(3.0)
    (logits, _), pose = apply(batch.source)
    (changed, _), same = apply(moved)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), pose, same)
    np.testing.assert_allclose(changed[:, :20], logits[:, :20], atol=1e-12)
    _, other = apply(batch.source.at[:, :20].add(3.0))
    assert np.abs(other.quaternion - pose.quaternion).max() > 1e-6


def test_masks_are_the_larger_logit_of_the_iteration_before_and_come_late(network, batch):
    module, variables = network
    steps = evaluate(module, variables, batch).steps
    for mask in (*steps[0].masks, *steps[1].masks):
        np.testing.assert_array_equal(mask, 1)
    for mask, logits in zip(steps[2].masks, steps[1].logits, strict=True):
        np.testing.assert_array_equal(mask, np.argmax(logits, axis=-1))
    np.testing.assert_array_equal(overlapping(jnp.zeros((1, 4, 2))), 0)


def test_scores_are_probabilities_of_the_last_logits(network, batch):
    module, variables = network
    prediction = evaluate(module, variables, batch)
    for score, logits in zip((prediction.source_overlap, prediction.target_overlap), prediction.steps[-1].logits, strict=True):
        odds = np.exp(logits[..., 1] - logits[..., 0])
        np.testing.assert_allclose(score, odds / (1 + odds))


def test_no_point_left_is_finite_in_evaluation_and_in_training(network, batch):
    _, variables = network
    flags = dataclasses.replace(FLAGS, iterations=2, unmasked=1)
    module, empty = OMNET.build(flags, ComputeConfig()), biased(variables, "stages_0", -1e3)

    def total(params):
        prediction, _ = module.apply(empty | {"params": params}, batch, train=True, key=None, mutable=["batch_stats"])
        return sum(losses(prediction, batch, flags, ComputeConfig()).values()), prediction

    gradient, prediction = jax.jit(jax.grad(total, has_aux=True))(empty["params"])
    assert not np.any(prediction.steps[1].masks[0])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((gradient, prediction, evaluate(module, empty, batch))))


def test_labels_are_overlap_and_need_kept_points_on_both_sides(batch):
    near = near_pairs(batch, 0.1)
    everything = jnp.ones((2, 30)), jnp.ones((2, 40))
    source, target = overlap_labels(near, everything)
    np.testing.assert_array_equal(source[:, 10:], True)
    np.testing.assert_array_equal(target[:, 20:], False)
    np.testing.assert_array_equal(target[:, :20], True)
    source, target = overlap_labels(near, (everything[0].at[:, 10:20].set(0), everything[1]))
    np.testing.assert_array_equal(source[:, 10:20], False)
    np.testing.assert_array_equal(source[:, 20:], True)
    assert not np.any(target[:, :10] & ~np.any(near[:, :10, :10] | near[:, 20:, :10], axis=1))


def test_right_logits_have_little_classification_loss_and_classes_are_weighted(network, batch):
    module, variables = network
    prediction = evaluate(module, variables, batch)
    near = near_pairs(batch, FLAGS.overlap_threshold)
    labels = overlap_labels(near, prediction.steps[0].masks)

    def classified(sign):
        logits = tuple(sign * jnp.where(label[..., None], jnp.asarray([0.0, 20.0]), jnp.asarray([20.0, 0.0])) for label in labels)
        steps = (prediction.steps[0].replace(logits=logits), *prediction.steps[1:])
        return losses(prediction.replace(steps=steps), batch, FLAGS, ComputeConfig())["overlap_0"]

    assert classified(1) < 1e-8
    assert classified(-1) == pytest.approx(20)
    constant = prediction.steps[0].replace(logits=(jnp.zeros((2, 30, 2)).at[..., 1].set(-20), jnp.zeros((2, 40, 2)).at[..., 1].set(-20)))
    terms = losses(prediction.replace(steps=(constant,)), batch, FLAGS, ComputeConfig())
    shares = [0.3 * label.sum() / (0.3 * label.sum() + 0.7 * (~label).sum()) for label in labels]
    assert terms["overlap_0"] == pytest.approx(20 * sum(shares) / 2)
