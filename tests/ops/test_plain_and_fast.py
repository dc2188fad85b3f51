"""Every operation with two versions: equal values and derivatives, in both precisions, for odd and prime sizes, whole and in chunks."""

from dataclasses import dataclass
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.pairs import PairLayer, PairNetwork
from cmig_jax.ops import convolution, pair_loops
from cmig_jax.ops.attention import attend
from cmig_jax.ops.best_target import best_target
from cmig_jax.ops.convolution import convolve
from cmig_jax.ops.edges import edge_moments, neighbour_maximum
from cmig_jax.ops.kernels import is_fast
from cmig_jax.ops.moments import moments, scale_about
from cmig_jax.ops.neighbours import knn
from cmig_jax.ops.pooling import max_pool, maximum, selected_maximum
from cmig_jax.ops.procrustes import project_to_rotation, weighted_procrustes

BOUND = {"float64": 1e-10, "float32": 1e-5}


@dataclass(frozen=True)
class Op:
    """A function of (compute, *arrays), the shapes of its arrays, rows per chunk, and numbers per chunk of images."""

    call: object
    shapes: tuple[tuple[int, ...], ...]
    rows: int = 0
    numbers: int = 3000  # chunks of two images for those of stride 1 and of the stem: the last one is padded


def neighbours_of(x, k):
    return knn(x, k, ComputeConfig())


def edges(compute, p, q, points):
    index = neighbours_of(points, 5)
    found = edge_moments((p,), (q,), (index,), compute)
    return found.mean, found.variance


def edges_of_two_clouds(compute, p, q, other_p, other_q):
    found = edge_moments((p, other_p), (q, other_q), (neighbours_of(p, 4), neighbours_of(other_p, 4)), compute)
    return found.mean, found.variance


def statistics(compute, a, b):
    found = moments([a, b], compute.kernels)
    return found.mean, found.variance


def pose(centroid, compute, source, target, weight):
    weight = weight**2 / jnp.sum(weight**2, axis=-1, keepdims=True)
    found = weighted_procrustes(source, target, weight, centroid, compute.kernels)
    return found.R, found.t


class Pairs(nn.Module):
    """The two networks over pairs of a head: from features, and from coordinates with extra numbers per row."""

    compute: ComputeConfig
    pooled: bool

    @nn.compact
    def __call__(self, f, g, x, y, train):
        pairs = PairLayer(6, compute=self.compute)(f, g) + PairLayer(6, reverse=True, compute=self.compute)(x, y, x)
        return PairNetwork((6, 5, 3), pooled=self.pooled, compute=self.compute)(pairs, train=train)


def pair_network(train, pooled, compute, parameters, f, g, x, y):
    module = Pairs(compute, pooled)
    shapes = jax.eval_shape(partial(module.init, train=False), jax.random.key(0), f, g, x, y)
    template = jax.tree.map(lambda s: jnp.ones(s.shape, f.dtype), shapes)
    flat, unflatten = ravel_pytree(template["params"])
    assert flat.shape == parameters.shape
    variables = {"params": unflatten(parameters), "batch_stats": template["batch_stats"]}
    outputs, new = module.apply(variables, f, g, x, y, train, mutable=["batch_stats"])
    return [x for x in outputs if x is not None], new["batch_stats"]


PAIRS = ((6 * (1 + 5) + 6 * (1 + 3 + 3) + 6 * 5 + 5 * 3 + 3 + 1 + 2 * (6 + 5 + 3),), (2, 13, 5), (2, 11, 5), (2, 13, 3), (2, 11, 3))
OPS = {
    "convolution, Winograd": Op(lambda c, x, k: convolve(x, k, 1, c.kernels), ((5, 7, 9, 3), (3, 3, 3, 4))),
    "convolution, one channel": Op(lambda c, x, k: convolve(x, k, 2, c.kernels), ((3, 11, 8, 1), (7, 7, 1, 4))),
    "convolution, stride 2": Op(lambda c, x, k: convolve(x, k, 2, c.kernels), ((7, 9, 7, 2), (3, 3, 2, 5)), numbers=300),
    "convolution, shortcut": Op(lambda c, x, k: convolve(x, k, 2, c.kernels), ((3, 7, 6, 2), (1, 1, 2, 5)), numbers=120),
    "attention": Op(lambda c, q, k, v: attend(q, k, v, c), ((2, 3, 13, 4), (2, 3, 11, 4), (2, 3, 11, 4))),
    "attention in chunks": Op(lambda c, q, k, v: attend(q, k, v, c), ((2, 3, 13, 4), (2, 3, 11, 4), (2, 3, 11, 4)), rows=5),
    "neighbour maximum": Op(lambda c, x: neighbour_maximum(x, neighbours_of(x, 5), c.kernels), ((2, 13, 4),)),
    "edge moments": Op(edges, ((2, 13, 4), (2, 13, 4), (2, 13, 3))),
    "edge moments in chunks": Op(edges, ((2, 13, 4), (2, 13, 4), (2, 13, 3)), rows=4),
    "edge moments of two clouds": Op(edges_of_two_clouds, ((2, 13, 4), (2, 13, 4), (2, 17, 4), (2, 17, 4)), rows=6),
    "selected maximum": Op(lambda c, x: selected_maximum(x, 2) if is_fast(c.kernels) else maximum(x, 2, c.kernels), ((2, 5, 7, 3),)),
    "maximum": Op(lambda c, x: maximum(x, 1, c.kernels), ((2, 13, 4),)),
    "pooled windows": Op(lambda c, x: max_pool(x, c.kernels), ((2, 7, 10, 3),)),
    "moments": Op(statistics, ((2, 13, 4), (3, 5, 7, 4))),
    "normalisation": Op(lambda c, x, m, s: scale_about(x, m, s, c.kernels), ((2, 13, 4), (4,), (4,))),
    "rotation": Op(lambda c, m: project_to_rotation(m, c.kernels), ((5, 3, 3),)),
    "pose": Op(partial(pose, "weighted"), ((2, 13, 3), (2, 13, 3), (2, 13))),
    "pose, unweighted centroids": Op(partial(pose, "unweighted"), ((2, 13, 3), (2, 13, 3), (2, 13))),
    "best target": Op(lambda c, k, b, f, x: best_target(k, b, f, x, c), ((2, 5), (5,), (2, 13, 11), (2, 13, 11))),
    "best target in chunks": Op(lambda c, k, b, f, x: best_target(k, b, f, x, c), ((2, 5), (5,), (2, 13, 11), (2, 13, 11)), rows=4),
    "pair network": Op(partial(pair_network, True, False), PAIRS),
    "pair network in chunks": Op(partial(pair_network, True, True), PAIRS, rows=4),
    "pair network, evaluation": Op(partial(pair_network, False, True), PAIRS, rows=5),
}


def values_and_derivatives(op: Op, kernels: str, arrays):
    """Return the results, and the derivatives of their product with random numbers."""
    compute = ComputeConfig(kernels=kernels, rows=op.rows)

    def run(*inputs):
        results, pull = jax.vjp(lambda *x: op.call(compute, *x), *inputs)
        rng = np.random.default_rng(1)
        return results, pull(jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape), x.dtype), results))

    return jax.jit(run)(*arrays)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", OPS)
def test_plain_and_fast_agree(name, dtype, monkeypatch):
    monkeypatch.setattr(convolution, "NUMBERS_PER_CHUNK", OPS[name].numbers)
    monkeypatch.setitem(pair_loops.NUMBERS_PER_CHUNK, "cpu", 2 * 11 * 6 * 5)  # 3 chunks of 5 rows for 13
    op, rng = OPS[name], np.random.default_rng(0)
    with jax.enable_x64(dtype == "float64"):
        arrays = [jnp.asarray(rng.standard_normal(shape), dtype) for shape in op.shapes]
        plain, fast = (values_and_derivatives(op, kernels, arrays) for kernels in ("plain", "fast"))
    leaves = list(zip(jax.tree.leaves(plain), jax.tree.leaves(fast), strict=True))
    assert any(np.abs(x).max() > 0.01 for x, _ in leaves)
    for expected, found in leaves:
        assert found.dtype == expected.dtype == dtype
        np.testing.assert_allclose(found, expected, rtol=0, atol=BOUND[dtype] * max(1, np.abs(expected).max()))


@pytest.mark.parametrize("rows", [0, 5, 13])
@pytest.mark.parametrize("points", [13, 16])
def test_neighbours_are_the_same(points, rows):
    x = jnp.asarray(np.random.default_rng(0).standard_normal((2, points, 3)), jnp.float32)
    plain, fast = (knn(x, 5, ComputeConfig(kernels=kernels, rows=rows)) for kernels in ("plain", "fast"))
    np.testing.assert_array_equal(plain, fast)
    np.testing.assert_array_equal(plain[..., 0], np.broadcast_to(np.arange(points), (2, points)))
