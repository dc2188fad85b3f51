"""MaskNet: the mask moves with the points, the chosen points are the highest, and ICP behind it finds small motions."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.geometry.twists import exp
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.masknet.flags import MaskNetFlags
from cmig_jax.models.masknet.network import MASKNET, icp, losses, masked, true_mask
from cmig_jax.nn.pointnet import DenseBesidePooled
from cmig_jax.structs import Batch

SMALL = MaskNetFlags(widths=(8, 16), mask_widths=(16, 8), icp_iterations=3)


@pytest.fixture(autouse=True)
def wide():
    with jax.enable_x64(True):
        yield


def clouds(B=2, N=24, M=36, seed=0):
    """Pairs whose source is a part of the target: its points with the largest first coordinates."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(B, M, 3)) * (1, 0.7, 0.4)
    points = np.take_along_axis(points, np.argsort(-points[..., :1], axis=1), axis=1)
    pose = exp(jnp.asarray(0.2 * rng.uniform(-1, 1, (B, 6))))
    return Batch(source=jnp.asarray(points[:, :N]), target=pose.apply(points), target_from_source=pose)


@functools.cache
def network(flags):
    module = MASKNET.build(flags, ComputeConfig())
    return module, jax.jit(lambda variables, batch: predict(module, variables, batch))


@functools.cache
def variables():
    found = jax.jit(functools.partial(initial_variables, network(SMALL)[0], SMALL.needs))(jax.random.key(0))
    return jax.tree.map(lambda x: x.astype(jnp.float64), found)


def test_scores_follow_their_points_and_pairs_are_independent():
    batch, rng = clouds(), np.random.default_rng(1)
    whole = network(SMALL)[1](variables(), batch)
    mask = np.asarray(whole.target_overlap)
    assert mask.shape == (2, 36)
    assert ((mask > 0) & (mask < 1)).all()
    order = rng.permutation(36)
    mixed = network(SMALL)[1](variables(), batch.replace(source=batch.source[:, rng.permutation(24)], target=batch.target[:, order]))
    np.testing.assert_allclose(mixed.target_overlap, mask[:, order], atol=1e-12)
    np.testing.assert_allclose(mixed.target_from_source.as_matrix(), whole.target_from_source.as_matrix(), atol=1e-12)
    for i in range(2):
        alone = network(SMALL)[1](variables(), jax.tree.map(lambda x, i=i: x[i : i + 1], batch))
        np.testing.assert_allclose(alone.target_overlap[0], mask[i], atol=1e-12)
        np.testing.assert_allclose(alone.target_from_source.as_matrix()[0], whole.target_from_source.as_matrix()[i], atol=1e-12)


@pytest.mark.parametrize(("share", "N", "K"), [(0.0, 24, 24), (0.0, 50, 36), (0.5, 24, 18), (0.01, 24, 3)])
def test_the_points_with_the_highest_scores_are_chosen_and_replace_the_target(share, N, K):
    batch = clouds(N=36).replace(target_normals=jnp.asarray(np.random.default_rng(2).normal(size=(2, 36, 3))))
    batch = batch.replace(source=jnp.concatenate([batch.source, batch.source + 0.1], axis=1)[:, :N])
    prediction = network(replace(SMALL, share=share))[1](variables(), batch)
    chosen, mask = np.asarray(prediction.chosen), np.asarray(prediction.target_overlap)
    assert chosen.shape == (2, K)
    others = masked(prediction, batch)
    for i in range(2):
        assert set(chosen[i]) == set(np.argsort(-mask[i])[:K])
        np.testing.assert_array_equal(others.target[i], batch.target[i][chosen[i]])
        np.testing.assert_array_equal(others.target_normals[i], batch.target_normals[i][chosen[i]])
    assert masked(prediction, batch.replace(target_normals=None)).target_normals is None
    found = prediction.correspondences
    assert found.partner.shape == (2, N)
    moved = np.asarray(prediction.target_from_source.apply(batch.source))
    nearest = np.linalg.norm(moved[:, :, None] - np.asarray(others.target)[:, None], axis=-1).argmin(-1)
    np.testing.assert_array_equal(found.partner, nearest)


def test_icp_finds_a_small_motion_and_turns_with_both_clouds():
    batch = clouds(N=36)
    pose, partner = icp(batch.source, batch.target, 20)
    np.testing.assert_allclose(pose.as_matrix(), batch.target_from_source.as_matrix(), atol=1e-10)
    np.testing.assert_array_equal(partner, np.broadcast_to(np.arange(36), (2, 36)))
    again, _ = icp(batch.source + 5, batch.target - 3, 20)
    np.testing.assert_allclose(again.R, pose.R, atol=1e-10)
    gradient = jax.grad(lambda x: jnp.sum(icp(x, batch.target, 2)[0].t))(batch.source)
    np.testing.assert_array_equal(gradient, 0)


def test_the_true_mask_marks_the_points_that_the_source_shows():
    batch = clouds()
    label = np.asarray(true_mask(batch, 0.01))
    np.testing.assert_array_equal(label, np.broadcast_to(np.arange(36) < 24, (2, 36)))
    assert true_mask(batch, 100.0).all()


@functools.cache
def training(flags):
    module = MASKNET.build(flags, ComputeConfig())

    def loss(params, statistics, batch, label):
        state = {"params": params, "batch_stats": statistics}
        prediction, new = module.apply(state, batch, train=True, label=label, mutable=["batch_stats"])
        return sum(losses(prediction, batch, flags, ComputeConfig()).values()), new["batch_stats"]

    return jax.jit(jax.value_and_grad(loss, has_aux=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mse", "bce"])
def test_a_few_steps_lower_the_loss_and_a_given_label_is_the_one_of_the_true_pose(kind):
    batch, params, statistics = clouds(B=3), variables()["params"], variables()["batch_stats"]
    flags, adam = replace(SMALL, loss=kind, overlap_threshold=0.01), optax.adam(1e-2)
    given = training(flags)(params, statistics, batch, true_mask(batch, 0.01))[0][0]
    other = training(flags)(params, statistics, batch, 1 - true_mask(batch, 0.01))[0][0]
    state, values = adam.init(params), []
    for _ in range(12):
        (value, statistics), gradient = training(flags)(params, statistics, batch, None)
        updates, state = adam.update(gradient, state)
        params = optax.apply_updates(params, updates)
        values.append(float(value))
    assert values[0] == pytest.approx(float(given), abs=1e-12)
    assert values[0] != pytest.approx(float(other), abs=1e-3)
    assert values[-1] < 0.8 * values[0]


def test_pose_and_gradient_are_finite_where_all_points_are_one():
    batch = jax.tree.map(jnp.zeros_like, clouds()).replace(target_from_source=clouds().target_from_source)
    prediction = network(SMALL)[1](variables(), batch)
    value, gradient = training(SMALL)(variables()["params"], variables()["batch_stats"], batch, None)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((prediction.target_from_source, value, gradient)))


def test_a_layer_beside_a_pooled_vector_is_the_layer_on_both():
    rng = np.random.default_rng(0)
    points, pooled, layer = rng.normal(size=(2, 5, 3)), rng.normal(size=(2, 4)), DenseBesidePooled(6)
    params = layer.init(jax.random.key(0), points, pooled)
    both = np.concatenate([points, np.broadcast_to(pooled[:, None], (2, 5, 4))], axis=-1)
    own = params["params"]["layer"]
    np.testing.assert_allclose(layer.apply(params, points, pooled), both @ np.asarray(own["kernel"]) + np.asarray(own["bias"]), atol=1e-6)


def test_flags_that_cannot_be_are_refused():
    for change, message in (
        ({"widths": ()}, "model.widths"),
        ({"mask_widths": ()}, "model.mask-widths"),
        ({"share": 1.5}, "model.share"),
        ({"overlap_threshold": 0.0}, "model.overlap-threshold"),
        ({"icp_iterations": 0}, "model.icp-iterations"),
    ):
        with pytest.raises(FlagError, match=message):
            MaskNetFlags(**change)
