"""The heads against a direct computation from tensors of all pairs, and what their results depend on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.config import ComputeConfig
from cmig_jax.models.cmignet.heads import CMIGNetHead, IDAMHead, KeypointSet, PCRNetHead

HEADS = {"cmignet": CMIGNetHead(feature_widths=(6, 5), coordinate_widths=(4,)), "idam": IDAMHead(feature_widths=(6, 5))}


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def normal(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def keypoints():
    """Draw 7 source and 9 target keypoints, one of them in both sets."""
    source, target = (KeypointSet(points=normal(2, K, 3, seed=K), features=normal(2, K, 8, seed=-K % 99)) for K in (7, 9))
    target.points[:, 3], target.features[:, 3] = source.points[:, 2], source.features[:, 2]
    return source, target


run = jax.jit(lambda head, *arguments: head.apply(*arguments, train=False), static_argnums=0)


@pytest.fixture
def variables(random_variables):
    """Return the variables of each head."""
    return {name: random_variables(head, *keypoints(), train=False) for name, head in HEADS.items()}


def assert_same(a, b, atol=1e-12):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


def direct(name, variables, source, target, train):
    """Compute a head from the tensors of all pairs; return feature similarity, coordinate similarity (or None) and logit."""
    p, stats = variables["params"], variables["batch_stats"]

    def norm(x, p, stats):
        mean, var = (jnp.mean(x, range(x.ndim - 1)), jnp.var(x, range(x.ndim - 1))) if train else (stats["mean"], stats["var"])
        mean, var, scale, bias = (v.reshape((1,) * (x.ndim - 1) + (-1,)) for v in (mean, var, p["scale"], p["bias"]))
        return jax.nn.relu((x - mean) / jnp.sqrt(var + 1e-5) * scale + bias)

    def layers(x, p, stats):
        for i in range(len(p) // 2):
            x = norm(x @ p[f"layer_{i}"]["kernel"], p[f"norm_{i}"], stats[f"norm_{i}"])
        return x

    def dense(x, p):
        return x @ p["kernel"] + p["bias"].reshape((1,) * (x.ndim - 1) + (-1,))

    def tower(x, name):
        hidden = norm(x, p[name]["first_norm"], stats[name]["first_norm"])
        hidden = layers(hidden, p[name].get("hidden", {}), stats[name].get("hidden", {}))
        return dense(hidden, p[name]["last"])[..., 0], hidden

    def pairs(difference, *more):
        square = jnp.sum(difference**2, -1, keepdims=True)
        length = jnp.where(square == 0, 0, jnp.sqrt(jnp.where(square == 0, 1, square)))
        direction = jnp.where(square == 0, 0, difference / jnp.where(square == 0, 1, length + 1e-8))
        return jnp.concatenate([length, direction, *more], -1)

    a, b = source.features[:, :, None], target.features[:, None]
    x, y = source.points[:, :, None], target.points[:, None]
    features = pairs(b - a) @ p["feature_pairs"]["kernel"]
    coordinates = pairs(x - y, jnp.broadcast_to(x, (2, 7, 9, 3))) @ p["coordinate_pairs"]["kernel"]
    if name == "idam":
        feature, hidden = tower(features + coordinates, "tower")
        coordinate, pooled = None, jnp.max(hidden, 2)
    else:
        feature, coordinate = tower(features, "feature_tower")[0], tower(coordinates, "coordinate_tower")[0]
        pooled = jnp.max(dense(jnp.stack([feature, coordinate], -1), p["pre"]), 2)
    credible = layers(pooled, p["credibility"]["hidden"], stats["credibility"]["hidden"])
    return feature, coordinate, dense(credible, p["credibility"]["last"])[..., 0]


@pytest.mark.parametrize("name", HEADS)
def test_a_head_is_the_direct_computation_in_evaluation(name, variables):
    match = run(HEADS[name], variables[name], *keypoints())
    assert {x.dtype for x in jax.tree.leaves(match)} == {jnp.dtype("float64")}
    expected = jax.jit(direct, static_argnums=(0, 4))(name, variables[name], *keypoints(), False)
    assert_same((match.feature, match.coordinate, match.logit), expected)


@pytest.mark.parametrize("name", HEADS)
def test_a_head_and_its_gradients_are_the_direct_computations_in_training(name, variables):
    cotangents = normal(2, 7, 9, seed=5), normal(2, 7, 9, seed=6), normal(2, 7, seed=7)

    def gradients(function):
        def total(params, source, target):
            outputs = function({**variables[name], "params": params}, source, target)
            return sum(jnp.sum(c * y) for c, y in zip(cotangents, outputs, strict=True) if y is not None), outputs

        return jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True))(variables[name]["params"], *keypoints())

    def head(*arguments):
        module = HEADS[name].clone(compute=ComputeConfig(rows=3))
        match, _ = module.apply(*arguments, train=True, mutable=["batch_stats"])
        return match.feature, match.coordinate, match.logit

    assert_same(gradients(head), gradients(lambda *arguments: direct(name, *arguments, True)), atol=1e-10)


@pytest.mark.parametrize("name", HEADS)
def test_the_order_of_keypoints_is_the_order_of_the_matrix(name, variables):
    source, target = keypoints()
    rows, columns = np.random.default_rng(0).permutation(7), np.random.default_rng(1).permutation(9)
    match = run(HEADS[name], variables[name], source, target)
    permuted = (jax.tree.map(lambda x, o=order: x[:, o], k) for k, order in ((source, rows), (target, columns)))
    found = run(HEADS[name], variables[name], *permuted)
    np.testing.assert_allclose(found.feature, match.feature[:, rows][:, :, columns], atol=1e-12)
    np.testing.assert_allclose(found.logit, match.logit[:, rows], atol=1e-12)


def test_features_and_coordinates_are_compared_apart(variables):
    source, target = keypoints()

    def match(source, target):
        return run(HEADS["cmignet"], variables["cmignet"], source, target)

    before, moved = match(source, target), match(source.replace(points=source.points + 1), target)
    np.testing.assert_array_equal(moved.feature, before.feature)
    assert np.all(np.ptp(np.asarray(moved.coordinate - before.coordinate), axis=(1, 2)) > 0)
    np.testing.assert_array_equal(match(source, target.replace(features=target.features + 1)).coordinate, before.coordinate)


def test_regression_returns_rotations(random_variables):
    head = PCRNetHead(width=8)
    pose = jax.jit(head.apply)(random_variables(head, *keypoints()), *keypoints())
    np.testing.assert_allclose(pose.R @ pose.R.swapaxes(1, 2), np.eye(3)[None].repeat(2, 0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(pose.R), 1, atol=1e-12)
