"""The edge layer, split into two products per point, equals the layer written edge by edge."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.nn.edgeconv import EdgeConv, PointEncoder

C, WIDTH, K = 5, 8, 4


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def knn(x, k):
    """Find neighbours the plain way, `[B, N, k]`."""
    return np.argsort(np.sum((x[:, :, None] - x[:, None]) ** 2, -1), axis=-1)[..., :k]


@functools.partial(jax.jit, static_argnums=3)
def edge_by_edge(variables, clouds, neighbours, train):
    """Dense on [x_j - x_i, x_i], BatchNorm over all edges of all clouds, ReLU, maximum; return the running statistics too."""
    params, stats = variables["params"], variables["batch_stats"]["norm"]
    edges = []
    for x, index in zip(clouds, neighbours, strict=True):
        x_j = jax.vmap(lambda cloud, i: cloud[i])(x, index)
        x_i = jnp.broadcast_to(x[:, :, None], x_j.shape)
        edges.append(jnp.concatenate([x_j - x_i, x_i], -1) @ params["kernel"])
    mean, variance = stats["mean"], stats["var"]
    if train:
        every = jnp.concatenate([e.reshape(-1, e.shape[-1]) for e in edges])
        mean, variance = jnp.mean(every, 0), jnp.var(every, 0)
        stats = {"mean": 0.9 * stats["mean"] + 0.1 * mean, "var": 0.9 * stats["var"] + 0.1 * jnp.var(every, 0, ddof=1)}
    scale, bias = ((params["norm"][name])[None, None, None] for name in ("scale", "bias"))
    mean, variance = mean[None, None, None], variance[None, None, None]
    outputs = [jnp.max(jax.nn.relu((e - mean) / jnp.sqrt(variance + 1e-5) * scale + bias), 2) for e in edges]
    return tuple(outputs), stats


@pytest.fixture
def case(random_variables):
    """Return two clouds of different size, away from the origin, their neighbours, and variables with scales of both signs."""
    clouds = tuple(np.random.default_rng(n).normal(size=(2, n, C)) + 3 for n in (11, 14))
    neighbours = tuple(knn(x, K) for x in clouds)
    variables = random_variables(EdgeConv(WIDTH), clouds, neighbours, train=False)
    variables["params"]["norm"]["scale"][::2] *= -1
    return variables, clouds, neighbours


@functools.partial(jax.jit, static_argnums=3)
def layer(variables, clouds, neighbours, train):
    if not train:
        return EdgeConv(WIDTH).apply(variables, clouds, neighbours, train=False), variables["batch_stats"]["norm"]
    outputs, state = EdgeConv(WIDTH).apply(variables, clouds, neighbours, train=True, mutable=["batch_stats"])
    return outputs, state["batch_stats"]["norm"]


def assert_same(a, b, atol=1e-10):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


@pytest.mark.parametrize("train", [True, False])
def test_values_statistics_and_gradients_equal_the_edge_by_edge_layer(case, train):
    variables, clouds, neighbours = case
    cotangents = [np.random.default_rng(1).normal(size=(*x.shape[:2], WIDTH)) for x in clouds]

    def results(function):
        def total(params, clouds):
            outputs, stats = function({**variables, "params": params}, clouds, neighbours, train)
            return sum(jnp.sum(c * y) for c, y in zip(cotangents, outputs, strict=True)), (outputs, stats)

        return jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))(variables["params"], clouds)

    found = results(layer)
    assert {x.dtype for x in jax.tree.leaves(found)} == {jnp.dtype("float64")}
    assert_same(found, results(edge_by_edge), atol=1e-9)


def test_coincident_points_have_finite_gradients(case):
    clouds, neighbours, variables = (np.ones((1, 6, C)),), (np.broadcast_to(np.arange(K), (1, 6, K)),), case[0]

    def total(params, clouds):
        return jnp.sum(layer({**variables, "params": params}, clouds, neighbours, True)[0][0] ** 2)

    assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(jax.jit(jax.grad(total, argnums=(0, 1)))(variables["params"], clouds)))


@pytest.fixture
def encoder(random_variables):
    clouds = tuple(np.random.default_rng(seed).normal(size=(2, 12, 3)) for seed in (3, 4))
    net = PointEncoder(k=K, widths=(6, 7), dim=9)
    return net, random_variables(net, clouds, train=False), clouds


@functools.partial(jax.jit, static_argnums=0)
def evaluate(net, variables, clouds):
    return net.apply(variables, clouds, train=False)


def test_each_layer_sees_everything_before_it_on_the_graph_of_the_layer_before(encoder):
    net, variables, clouds = encoder

    def edge(i, inputs, latest):
        part = {kind: variables[kind][f"edge_{i}"] for kind in variables}
        return np.asarray(edge_by_edge(part, (inputs,), (knn(latest, K),), False)[0][0])

    x = clouds[0]
    first = edge(0, x, x)
    second = edge(1, np.concatenate([x, first], -1), first)
    last = np.concatenate([x, first, second], -1) @ variables["params"]["last"]["kernel"]
    stats, norm = variables["batch_stats"]["last_norm"], variables["params"]["last_norm"]
    expected = np.maximum((last - stats["mean"]) / np.sqrt(stats["var"] + 1e-5) * norm["scale"] + norm["bias"], 0)
    np.testing.assert_allclose(evaluate(net, variables, (x,))[0], expected, atol=1e-10)


def test_two_clouds_are_encoded_as_one_batch(encoder):
    net, variables, clouds = encoder

    @jax.jit
    def train(clouds):
        return net.apply(variables, clouds, train=True, mutable=["batch_stats"])

    (apart, stats), ((together,), joint) = train(clouds), train((np.concatenate(clouds),))
    assert_same(np.concatenate(apart), together)
    assert_same(stats, joint)


def test_the_order_of_points_is_the_order_of_the_features(encoder):
    net, variables, clouds = encoder
    (features,) = evaluate(net, variables, clouds[:1])
    order = np.random.default_rng(4).permutation(12)
    (permuted,) = evaluate(net, variables, (clouds[0][:, order],))
    assert_same(features[:, order], permuted)
