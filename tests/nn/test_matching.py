"""The correspondence search against what it abbreviates."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.matching import CMIGNetHead, IDAMHead, KeypointSet, PairLayer, PCRNetHead, pair_distances

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


@functools.partial(jax.jit, static_argnums=(0, 4))
def run(head, variables, source, target, train):
    return head.apply(variables, source, target, train=train, mutable=["batch_stats"] if train else False)


@pytest.fixture(scope="module")
def variables(random_like):
    """Draw variables of each head."""
    with jax.enable_x64(True):
        init = {name: functools.partial(head.init_with_output, train=False) for name, head in HEADS.items()}
        return {name: random_like(jax.eval_shape(f, jax.random.key(0), *keypoints())[1], dtype=np.float64) for name, f in init.items()}


def first_layer(layer, kernel, *inputs):
    """Give the first layer's value at every pair, `[B, R, K, features]`, whether it is returned whole or in parts."""
    pairs = layer.apply({"params": {"kernel": kernel}}, *inputs)
    return pairs if isinstance(pairs, jax.Array) else pairs.values()


def assert_same(a, b, atol=1e-12):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


@pytest.mark.parametrize("reverse", [False, True])
def test_pair_layer_is_the_matrix_on_length_direction_and_row_numbers(reverse):
    a, b, extra, kernel = normal(2, 5, 4), normal(2, 6, 4, seed=1) + 3, normal(2, 5, 2, seed=2), normal(7, 8, seed=3)
    difference = b[:, None] - a[:, :, None]
    length = np.linalg.norm(difference, axis=-1, keepdims=True)
    direction = (-difference if reverse else difference) / (length + 1e-8)
    inputs = np.concatenate([length, direction, np.broadcast_to(extra[:, :, None], (2, 5, 6, 2))], -1)
    layer = PairLayer(8, reverse=reverse)
    pairs = first_layer(layer, kernel, a, b, extra)
    np.testing.assert_allclose(pairs, inputs @ kernel, atol=1e-12)


@pytest.mark.parametrize("C", [3, 8])
def test_pair_distances_are_zero_with_a_zero_derivative_where_points_coincide(C):
    a, b = normal(1, 4, C), normal(1, 5, C, seed=1)
    b[0, 1] = a[0, 2]
    value, gradient = jax.jit(jax.value_and_grad(lambda a: jnp.sum(pair_distances(a, b)[0, 2])))(a)
    expected = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1)
    np.testing.assert_allclose(jax.jit(pair_distances)(a, b), expected, atol=1e-12)
    others = [j for j in range(5) if j != 1]
    slope = np.sum((a[0, 2] - b[0, others]) / expected[0, 2, others, None], axis=0)
    np.testing.assert_allclose(gradient[0, 2], slope, atol=1e-12)
    np.testing.assert_allclose(value, expected[0, 2].sum(), atol=1e-12)


@pytest.mark.parametrize("C", [3, 32])
def test_coincident_points_have_finite_gradients_in_float32(C):
    a = normal(1, 6, C).astype(np.float32) + 1
    kernel = normal(1 + C, 2).astype(np.float32)
    gradient = jax.jit(jax.grad(lambda a: jnp.sum(first_layer(PairLayer(2), kernel, a, a) ** 2)))(a)
    assert np.all(np.isfinite(gradient))
    np.testing.assert_array_equal(np.diagonal(pair_distances(a, a)[0]), 0)


@pytest.mark.parametrize("nearly", [0.0, 1e-6, 1e-4])
def test_nearly_equal_features_have_no_direction_larger_than_one(nearly):
    a, kernel = normal(1, 20, 64).astype(np.float32), normal(65, 4).astype(np.float32)
    b = np.concatenate([a * (1 + nearly * normal(1, 20, 64, seed=1)), normal(1, 9, 64, seed=2)], axis=1).astype(np.float32)
    pairs = np.asarray(first_layer(PairLayer(4), kernel, a, b))
    assert np.abs(np.diagonal(pairs, axis1=1, axis2=2)).max() < np.linalg.norm(kernel, axis=0).max()


@pytest.mark.parametrize("gap", [1e-2, 1e-5, 1e-7])
def test_statistics_keep_their_digits_where_the_pose_has_brought_points_onto_their_partners(gap):
    b, kernel = normal(2, 20, 3).astype(np.float32), normal(7, 8, seed=1).astype(np.float32)
    a = (b + gap * normal(2, 20, 3, seed=2)).astype(np.float32)
    batch = PairLayer(8, reverse=True).apply({"params": {"kernel": kernel}}, a, b, a).moments()
    difference = a.astype(np.float64)[:, :, None] - b[:, None]
    length = np.linalg.norm(difference, axis=-1, keepdims=True)
    inputs = np.concatenate([length, difference / (length + 1e-8), np.broadcast_to(a[:, :, None], difference.shape)], -1)
    pairs = inputs @ kernel.astype(np.float64)
    np.testing.assert_allclose(batch.mean, pairs.mean(axis=(0, 1, 2)), atol=1e-5)
    np.testing.assert_allclose(batch.variance, pairs.var(axis=(0, 1, 2)), rtol=1e-5)


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
@pytest.mark.parametrize("rows", [0, 2])
def test_a_head_is_the_direct_computation_in_evaluation(name, rows, variables):
    match = run(HEADS[name].clone(rows=rows), variables[name], *keypoints(), False)
    expected = jax.jit(direct, static_argnums=(0, 4))(name, variables[name], *keypoints(), False)
    assert {x.dtype for x in jax.tree.leaves(match)} == {jnp.dtype("float64")}
    assert_same((match.feature, match.coordinate, match.logit), expected)


@pytest.mark.parametrize(("name", "chunks"), [("cmignet", (0, 3)), ("idam", (3,))])
def test_a_head_and_its_gradients_are_the_direct_computations_in_training(name, chunks, variables):
    cotangents = normal(2, 7, 9, seed=5), normal(2, 7, 9, seed=6), normal(2, 7, seed=7)

    def gradients(function):
        def total(params, source, target):
            outputs, stats = function({**variables[name], "params": params}, source, target)
            return sum(jnp.sum(c * y) for c, y in zip(cotangents, outputs, strict=True) if y is not None), (outputs, stats)

        (_, (outputs, stats)), slopes = jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True))(
            variables[name]["params"], *keypoints()
        )
        return (outputs, slopes), stats

    def ours(rows, *arguments):
        match, state = HEADS[name].clone(rows=rows).apply(*arguments, train=True, mutable=["batch_stats"])
        return (match.feature, match.coordinate, match.logit), state

    results = [gradients(functools.partial(ours, rows)) for rows in chunks]
    expected, _ = gradients(lambda *arguments: (direct(name, *arguments, True), None))
    for result, stats in results:
        assert_same(result, expected, atol=1e-10)
        assert_same(stats, results[0][1])


@pytest.mark.parametrize("name", HEADS)
def test_the_order_of_keypoints_is_the_order_of_the_matrix(name, variables):
    source, target = keypoints()
    rows, columns = np.random.default_rng(0).permutation(7), np.random.default_rng(1).permutation(9)
    match = run(HEADS[name], variables[name], source, target, False)
    permuted = run(
        HEADS[name], variables[name], *(jax.tree.map(lambda x, o=o: x[:, o], k) for k, o in ((source, rows), (target, columns))), False
    )
    np.testing.assert_allclose(permuted.feature, match.feature[:, rows][:, :, columns], atol=1e-12)
    np.testing.assert_allclose(permuted.logit, match.logit[:, rows], atol=1e-12)


def test_features_and_coordinates_are_compared_apart(variables):
    source, target = keypoints()
    match = run(HEADS["cmignet"], variables["cmignet"], source, target, False)
    moved = run(HEADS["cmignet"], variables["cmignet"], source.replace(points=source.points + 1), target, False)
    np.testing.assert_array_equal(moved.feature, match.feature)
    assert np.all(np.ptp(np.asarray(moved.coordinate - match.coordinate), axis=(1, 2)) > 0)
    shifted = run(HEADS["cmignet"], variables["cmignet"], source, target.replace(features=target.features + 1), False)
    np.testing.assert_array_equal(shifted.coordinate, match.coordinate)


def test_regression_returns_rotations_whatever_it_is_given(random_like):
    head = PCRNetHead(width=8)
    source, target = keypoints()
    shapes = jax.eval_shape(head.init, jax.random.key(0), source, target)
    pose = jax.jit(head.apply)(random_like(shapes, dtype=np.float64), source, target)
    np.testing.assert_allclose(pose.R @ pose.R.swapaxes(1, 2), np.eye(3)[None].repeat(2, 0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(pose.R), 1, atol=1e-12)
