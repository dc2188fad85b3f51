"""DCP: what its pose depends on, its encoder edge by edge, and its losses."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import ComputeConfig, FlagError
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.dcp.network import DCP, DCPFlags, DCPNetwork, losses
from cmig_jax.nn.edgeconv import StaticEdgeEncoder
from cmig_jax.nn.pointer import pointed_pose
from cmig_jax.transform import RigidTransform

from .random_pairs import assert_same, pairs

TINY = DCPFlags(k=4, widths=(6, 8), dim=8, heads=2, feed_forward=12)
V1 = dataclasses.replace(TINY, pointer="identity")
VERSIONS = pytest.mark.parametrize("flags", [TINY, V1], ids=["v2", "v1"])
evaluate = jax.jit(predict, static_argnums=0)


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


@VERSIONS
def test_the_pose_does_not_depend_on_the_order_of_points_or_on_the_other_pairs(flags, random_variables):
    network, batch = DCPNetwork(flags), pairs()
    variables = random_variables(network, batch, train=False)
    whole, orders = (
        evaluate(network, variables, batch),
        (np.random.default_rng(1).permutation(17), np.random.default_rng(2).permutation(23)),
    )
    permuted = evaluate(network, variables, batch.replace(source=batch.source[:, orders[0]], target=batch.target[:, orders[1]]))
    assert_same(permuted.target_from_source, whole.target_from_source)
    np.testing.assert_array_equal(orders[1][permuted.correspondences.partner], np.asarray(whole.correspondences.partner)[:, orders[0]])
    alone = evaluate(network, variables, jax.tree.map(lambda x: x[:1].repeat(2, 0), batch))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y[:1].repeat(2, 0), atol=1e-9), alone, whole)


@VERSIONS
def test_the_pose_solves_for_the_means_that_the_points_point_to(flags, random_variables):
    network, batch = DCPNetwork(flags), pairs()
    found = evaluate(network, random_variables(network, batch, train=False), batch)
    for i in range(2):
        rotation, _ = Rotation.align_vectors(*(x - x.mean(0) for x in (np.asarray(found.partners[i]), batch.source[i])))
        np.testing.assert_allclose(found.target_from_source.R[i], rotation.as_matrix(), atol=1e-8)
    np.testing.assert_allclose(found.target_from_source.apply(batch.source).mean(1), found.partners.mean(1), atol=1e-12)
    np.testing.assert_allclose(found.correspondences.weight.sum(1), 1)
    assert_same(found.source_from_target, found.target_from_source.inverse())


def test_v1_points_by_doubled_features(random_variables):
    f, g = np.random.default_rng(0).normal(size=(2, 1, 5, 8))
    pointer = np.asarray(DCPNetwork(V1).point(*DCPNetwork(V1).embed(f, g)))
    logits = 4 * f[0] @ g[0].T / np.sqrt(8)
    np.testing.assert_allclose(pointer[0], np.exp(logits) / np.exp(logits).sum(1, keepdims=True), atol=1e-12)


def edge_by_edge(variables, cloud, train):
    """Run the encoder's layers on `[x_j, x_i]` of all edges."""
    index = np.argsort(np.sum((cloud[:, :, None] - cloud[:, None]) ** 2, -1), axis=-1)[..., :4]
    neighbour = np.stack([points[i] for points, i in zip(cloud, index, strict=True)])
    edges, pooled = np.concatenate([neighbour, np.broadcast_to(cloud[:, :, None], neighbour.shape)], -1), []

    def normed(x, name):
        axes, own, statistics = tuple(range(x.ndim - 1)), variables["params"][name], variables["batch_stats"][name]
        mean, variance = (x.mean(axes), x.var(axes)) if train else (statistics["mean"], statistics["var"])
        return np.maximum((x - mean) / np.sqrt(variance + 1e-5) * own["scale"] + own["bias"], 0)

    for i in range(2):
        edges = normed(edges @ variables["params"][f"edges_{i}"]["kernel"], f"norms_{i}")
        pooled.append(edges.max(2))
    return normed(np.concatenate(pooled, -1) @ variables["params"]["last"]["kernel"], "last_norm")


@pytest.mark.parametrize("train", [False, True])
@pytest.mark.parametrize("compute", [ComputeConfig(), ComputeConfig(kernels="plain", rows=5)], ids=["fast", "plain, rows"])
def test_the_encoder_equals_its_layers_edge_by_edge(train, compute, random_variables):
    cloud, encoder = pairs().source, StaticEdgeEncoder(4, (6, 8), 8, compute)
    variables = random_variables(encoder, cloud, train=False)
    variables["params"]["norms_1"]["scale"][::2] *= -1
    found, _ = encoder.apply(variables, cloud, train=train, mutable=["batch_stats"])
    np.testing.assert_allclose(found, edge_by_edge(variables, cloud, train), atol=1e-10)


def test_pointers_that_are_almost_uniform_keep_their_digits_in_float32():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(1, 200, 3))
    truth = RigidTransform(R=Rotation.random(rng=rng).as_matrix()[None], t=np.array([[3.0, -2, 5]]))
    target = truth.apply(source)
    pointer = np.exp(1e-4 * source @ source.swapaxes(1, 2))
    pointer /= pointer.sum(-1, keepdims=True)
    exact, _ = pointed_pose(*map(jnp.asarray, (pointer, source, target)))
    narrow, _ = pointed_pose(*(jnp.asarray(x, jnp.float32) for x in (pointer, source, target)))
    assert float(narrow.inverse().compose(RigidTransform(R=exact.R, t=exact.t)).angle()[0]) < 3e-3


def test_the_losses_are_zero_at_the_truth_and_the_consistent_cycle_at_inverse_poses(random_variables):
    flags, batch = dataclasses.replace(TINY, cycle="consistent"), pairs()
    found = evaluate(DCPNetwork(flags), random_variables(DCPNetwork(flags), batch, train=False), batch)
    truth = batch.target_from_source
    exact = found.replace(target_from_source=truth, source_from_target=truth.inverse())
    assert_same(
        losses(exact, batch, flags, ComputeConfig()), dict.fromkeys(("rotation", "translation", "cycle_rotation", "cycle_translation"), 0)
    )
    assert losses(exact, batch, dataclasses.replace(flags, cycle="official"), ComputeConfig())["cycle_translation"] > 1e-3
    values = losses(found, batch, flags, ComputeConfig())
    error = np.asarray(found.target_from_source.R).swapaxes(1, 2) @ truth.R - np.eye(3)[None]
    np.testing.assert_allclose(values["rotation"], np.mean(error**2))
    there, back = found.target_from_source, found.source_from_target
    np.testing.assert_allclose(values["cycle_rotation"], 0.1 * np.mean((back.R @ there.R - np.eye(3)[None]) ** 2))
    np.testing.assert_allclose(values["cycle_translation"], 0.1 * np.mean(back.compose(there).t ** 2))
    assert set(losses(found, batch, TINY, ComputeConfig())) == {"rotation", "translation"}


@pytest.mark.slow
def test_training_lowers_the_loss_with_finite_gradients(random_variables):
    with jax.enable_x64(False):
        flags, batch = dataclasses.replace(TINY, cycle="official"), pairs(16, 20, np.float32)
        network, optimiser = DCP.build(flags, ComputeConfig()), optax.adam(3e-3)
        variables = random_variables(network, batch, dtype=np.float32, train=True)

        def total(params, statistics):
            found, new = network.apply({"params": params, "batch_stats": statistics}, batch, train=True, mutable=["batch_stats"])
            return sum(losses(found, batch, flags, ComputeConfig()).values()), new["batch_stats"]

        @jax.jit
        def step(params, statistics, state):
            (loss, statistics), slope = jax.value_and_grad(total, has_aux=True)(params, statistics)
            change, state = optimiser.update(slope, state)
            return optax.apply_updates(params, change), statistics, state, loss, slope

        params, statistics, state, history = variables["params"], variables["batch_stats"], optimiser.init(variables["params"]), []
        for _ in range(25):
            params, statistics, state, loss, slope = step(params, statistics, state)
            history.append(float(loss))
            assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))
        assert history[-1] < 0.9 * history[0]


@VERSIONS
def test_the_smallest_batch_initialises_the_network(flags):
    shapes = jax.eval_shape(lambda key: initial_variables(DCPNetwork(flags), flags.needs, key), jax.random.key(0))
    assert ("transformer" in shapes["params"]) == (flags.pointer == "transformer")


def test_too_few_points_and_wrong_flags_are_refused():
    with pytest.raises(ValueError, match=r"at least 4 points.*got 3 and 9"):
        DCPNetwork(TINY).init(jax.random.key(0), pairs(3, 9), train=True)
    for change, message in (
        ({"heads": 3}, "model.heads = 3: expected a divisor of model.dim = 8"),
        ({"k": 0}, "model.k = 0"),
        ({"widths": ()}, "model.widths"),
    ):
        with pytest.raises(FlagError, match=message):
            dataclasses.replace(TINY, **change)
