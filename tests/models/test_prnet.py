"""PRNet: what its pose depends on, its matching and its noise, its encoder and its losses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.prnet.network import PRNET, PRNet, PRNetFlags, losses
from cmig_jax.nn.edgeconv import EdgeConv

from .random_pairs import assert_same, pairs

TINY = PRNetFlags(k=4, widths=(6, 8), dim=8, heads=2, feed_forward=12, keypoints=12, iterations=2)
SOFT = dataclasses.replace(TINY, matching="softmax")
MATCHINGS = pytest.mark.parametrize("flags", [dataclasses.replace(TINY, iterations=1), SOFT], ids=["gumbel", "softmax"])
evaluate = jax.jit(predict, static_argnums=0)


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


@MATCHINGS
def test_without_a_key_the_pose_repeats_and_depends_neither_on_the_order_of_points_nor_on_other_pairs(flags, random_variables):
    network, batch = PRNet(flags), pairs()
    variables = random_variables(network, batch, train=False)
    whole, orders = (
        evaluate(network, variables, batch),
        (np.random.default_rng(1).permutation(17), np.random.default_rng(2).permutation(23)),
    )
    permuted = evaluate(network, variables, batch.replace(source=batch.source[:, orders[0]], target=batch.target[:, orders[1]]))
    assert_same(permuted.target_from_source, whole.target_from_source)
    np.testing.assert_array_equal(orders[0][permuted.correspondences.source_index], whole.correspondences.source_index)
    np.testing.assert_array_equal(orders[1][permuted.correspondences.target_index], whole.correspondences.target_index)
    alone = evaluate(network, variables, jax.tree.map(lambda x: x[:1].repeat(2, 0), batch))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y[:1].repeat(2, 0), atol=1e-9), alone, whole)


def test_the_pose_is_the_composition_of_the_steps_which_see_the_moved_source(random_variables):
    network, batch = PRNet(SOFT), pairs()
    variables = random_variables(network, batch, train=False)
    found = evaluate(network, variables, batch)
    first, second = found.iterations
    assert_same(first.pose, first.step)
    assert_same(found.target_from_source, second.step.compose(first.step))
    again = evaluate(network, variables, batch.replace(source=first.step.apply(jnp.asarray(batch.source))))
    assert_same(again.iterations[0], dataclasses.replace(second, pose=second.step))


def test_keypoints_are_the_points_of_the_largest_features_and_at_most_all(random_variables):
    features, points = np.random.default_rng(0).normal(size=(2, 9, 8)), pairs(9).source
    for count, flags in ((5, dataclasses.replace(TINY, test_keypoints=5)), (9, TINY)):
        chosen = PRNet(flags).choose(points, features, False, None)
        expected = np.argsort(-np.linalg.norm(features, axis=-1), axis=1)[:, :count]
        np.testing.assert_array_equal(chosen.index, expected)
        np.testing.assert_array_equal(chosen.points, np.take_along_axis(points, expected[..., None], 1))
        np.testing.assert_array_equal(chosen.features, np.take_along_axis(features, expected[..., None], 1))


def test_gumbel_partners_are_single_and_have_the_derivative_of_the_softmax():
    rng = np.random.default_rng(0)
    logits, noise, direction = rng.normal(size=(2, 5, 7)), rng.gumbel(size=(2, 5, 7)), rng.normal(size=(2, 5, 7))
    temperature = np.array([[0.5], [2.0]])
    hard = np.asarray(PRNet(TINY).point(jnp.asarray(logits), temperature, noise))
    np.testing.assert_allclose(hard, np.eye(7)[(logits + noise).argmax(-1)], atol=1e-12)
    slope = jax.grad(lambda x: jnp.sum(direction * PRNet(TINY).point(x, temperature, noise)))(jnp.asarray(logits))
    soft = jax.grad(lambda x: jnp.sum(direction * jax.nn.softmax((x + noise) / temperature[:, :, None], -1)))(jnp.asarray(logits))
    np.testing.assert_allclose(slope, soft, atol=1e-12)
    weights = PRNet(SOFT).point(jnp.asarray(logits), temperature, None)
    np.testing.assert_allclose(weights, jax.nn.softmax(logits * temperature[:, :, None], -1), atol=1e-12)


def test_noise_follows_the_key_and_given_noise_replaces_it():
    logits = jnp.zeros((3, 4, 4))
    draw = PRNet(TINY)._noise
    (a, back), (b, _), (c, _), (fixed, _) = (
        draw(jax.random.key(1), 0, logits),
        draw(jax.random.key(1), 1, logits),
        draw(jax.random.key(2), 0, logits),
        draw(None, 0, logits),
    )
    assert a.dtype == jnp.float64
    assert len({float(x[0, 0, 0]) for x in (a, back, b, c, fixed)}) == 5
    assert a.shape == (3, 4, 4)
    assert fixed.shape == (1, 4, 4)


def test_an_edge_layer_with_absolute_neighbours_and_a_leaky_activation_equals_itself_edge_by_edge(random_variables):
    cloud, rng = pairs().source, np.random.default_rng(3)
    index = rng.permuted(np.tile(np.arange(17), (2, 17, 1)), axis=-1)[..., :4]
    layer = EdgeConv(6, relative=False, negative_slope=0.2)
    variables = random_variables(layer, (cloud,), (index,), train=False)
    variables["params"]["norm"]["scale"][::2] *= -1
    neighbour = np.stack([points[i] for points, i in zip(cloud, index, strict=True)])
    edges = np.concatenate([neighbour, np.broadcast_to(cloud[:, :, None], neighbour.shape)], -1) @ variables["params"]["kernel"]
    for train in (False, True):
        ((found,), _) = layer.apply(variables, (cloud,), (index,), train=train, mutable=["batch_stats"])
        own, statistics = variables["params"]["norm"], variables["batch_stats"]["norm"]
        mean, variance = (edges.mean((0, 1, 2)), edges.var((0, 1, 2))) if train else (statistics["mean"], statistics["var"])
        normed = (edges - mean) / np.sqrt(variance + 1e-5) * own["scale"] + own["bias"]
        np.testing.assert_allclose(found, np.where(normed > 0, normed, 0.2 * normed).max(2), atol=1e-10)


def test_the_losses_are_zero_at_the_truth_and_the_consistent_cycle_at_inverse_poses(random_variables):
    flags, batch = dataclasses.replace(SOFT, cycle="consistent"), pairs()
    found = evaluate(PRNet(SOFT), random_variables(PRNet(SOFT), batch, train=False), batch)
    truth = batch.target_from_source
    exact = found.replace(
        iterations=tuple(
            dataclasses.replace(x, pose=truth, step=truth, back=truth.inverse(), disparity=0 * x.disparity) for x in found.iterations
        )
    )
    terms = losses(exact, batch, flags, ComputeConfig())
    assert_same(terms, {f"{name}_{i}": 0.0 for i in range(2) for name in ("cycle", "feature", "pose")})
    assert losses(exact, batch, dataclasses.replace(flags, cycle="official"), ComputeConfig())["cycle_0"] > 1e-3
    last, values = found.iterations[1], losses(found, batch, flags, ComputeConfig())
    there, back, error = last.step, last.back, np.asarray(last.pose.R).swapaxes(1, 2) @ truth.R - np.eye(3)[None]
    np.testing.assert_allclose(values["pose_1"], 0.9 * (np.mean(error**2) + np.mean((last.pose.t - truth.t) ** 2)))
    around = np.mean((there.R @ back.R - np.eye(3)[None]) ** 2) + np.mean(there.compose(back).t ** 2)
    np.testing.assert_allclose(values["cycle_1"], 0.9 * 0.1 * around)
    assert not any(name.startswith("cycle") for name in losses(found, batch, dataclasses.replace(flags, cycle="off"), ComputeConfig()))


@pytest.mark.slow
def test_training_lowers_the_loss_with_finite_gradients(random_variables):
    with jax.enable_x64(False):
        flags, batch = dataclasses.replace(TINY, iterations=1), pairs(16, 20, np.float32)
        network, optimiser, key = PRNET.build(flags, ComputeConfig()), optax.adam(3e-3), jax.random.key(0)
        variables = random_variables(network, batch, dtype=np.float32, train=True, key=key)

        def total(params, statistics):
            variables = {"params": params, "batch_stats": statistics}
            found, new = network.apply(variables, batch, train=True, key=key, mutable=["batch_stats"])
            return sum(losses(found, batch, flags, ComputeConfig()).values()), new["batch_stats"]

        @jax.jit
        def step(params, statistics, state):
            (loss, statistics), slope = jax.value_and_grad(total, has_aux=True)(params, statistics)
            change, state = optimiser.update(slope, state)
            return optax.apply_updates(params, change), statistics, state, loss, slope

        params, statistics, state, history = variables["params"], variables["batch_stats"], optimiser.init(variables["params"]), []
        for _ in range(40):
            params, statistics, state, loss, slope = step(params, statistics, state)
            history.append(float(loss))
            assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))
        assert np.mean(history[-5:]) < 0.9 * history[0]


def test_the_smallest_batch_initialises_the_network():
    shapes = jax.eval_shape(lambda key: initial_variables(PRNet(TINY), TINY.needs, key), jax.random.key(0))
    assert set(shapes["params"]) == {"encoder", "transformer", "temperature_hidden", "temperature_last"}


def test_training_without_a_key_too_few_points_and_wrong_flags_are_refused():
    with pytest.raises(ValueError, match="Gumbel noise: expected a key"):
        PRNet(TINY).init(jax.random.key(0), pairs(), train=True)
    with pytest.raises(ValueError, match=r"at least 12 points.*got 9 and 23"):
        PRNet(TINY).init(jax.random.key(0), pairs(9), train=True, key=jax.random.key(0))
    changes = (
        ({"heads": 3}, "model.heads = 3: expected a divisor"),
        ({"keypoints": 2}, "model.keypoints = 2"),
        ({"discount": 0.0}, "model.discount"),
    )
    for change, message in changes:
        with pytest.raises(FlagError, match=message):
            dataclasses.replace(TINY, **change)
