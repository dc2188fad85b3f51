"""Chunks: their lengths and padding, loops over rows, and what `compute.rows` must keep out of a program."""

import math
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr, Jaxpr

from cmig_jax.bench.products import products_of
from cmig_jax.config import ComputeConfig
from cmig_jax.models.cmignet.losses import overlap
from cmig_jax.nn.edgeconv import PointEncoder
from cmig_jax.nn.pairs import PairLayer, PairNetwork
from cmig_jax.ops.attention import attend
from cmig_jax.ops.best_target import best_target
from cmig_jax.ops.chunks import chunk_length, join, map_rows, split
from cmig_jax.ops.neighbours import knn, nearest

N, M, ROWS = 97, 101, 16


def inner_programs(equation):
    values = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda x: isinstance(x, Jaxpr | ClosedJaxpr))
    return [getattr(x, "jaxpr", x) for x in values if isinstance(x, Jaxpr | ClosedJaxpr)]


def largest_array(program):
    """Return the size of the largest array in a traced program, in loops and derivatives too."""
    program = getattr(program, "jaxpr", program)
    sizes = [math.prod(x.aval.shape) for equation in program.eqns for x in equation.outvars]
    return max([*sizes, *(largest_array(inner) for equation in program.eqns for inner in inner_programs(equation))], default=0)


def loop_steps(program):
    """Return how many steps the loops of a traced program take together."""
    program = getattr(program, "jaxpr", program)
    steps = 0
    for equation in program.eqns:
        length = equation.params["length"] if equation.primitive.name == "scan" else 1
        steps += length * sum(map(loop_steps, inner_programs(equation)), int(equation.primitive.name == "scan"))
    return steps


def normal(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def test_chunks_are_the_fewest_of_equal_length_that_cover_an_axis():
    length = chunk_length(9973, 512)
    assert (length, math.ceil(9973 / length)) == (499, 20)
    for points in (1, 2, 383, 384, 9973):
        for most in (1, 2, 17, 127, 128, 384, 10_000):
            length = chunk_length(points, most)
            assert 1 <= length <= most
            assert math.ceil(points / length) == math.ceil(points / most)
    assert chunk_length(5, 0) == 1
    for most in range(2, 383):  # a prime number of rows makes no more chunks than the next number
        assert math.ceil(383 / chunk_length(383, most)) == math.ceil(384 / chunk_length(384, most))


@pytest.mark.parametrize("size", [1, 3, 4, 8, 11])
@pytest.mark.parametrize("axis", [0, 1, -2])
def test_join_undoes_split(axis, size):
    x = np.arange(8 * 7 * 10).reshape(8, 7, 10)
    chunks = split(jnp.asarray(x), axis, size)
    assert chunks.shape[0] == math.ceil(x.shape[axis] / size)
    np.testing.assert_array_equal(join(chunks, axis % 3, x.shape[axis]), x)


@pytest.mark.parametrize("rows", [0, 1, 4, 10, 99])
def test_map_rows_joins_trees_of_any_rank_in_order_and_is_differentiable(rows):
    x = np.arange(60, dtype=np.float32).reshape(2, 3, 10, 1)
    result = map_rows(lambda c: {"rank 3": c[..., 0] ** 2, "rank 5": jnp.stack([c, -c], -1)}, x, rows)
    np.testing.assert_array_equal(result["rank 3"], x[..., 0] ** 2)
    np.testing.assert_array_equal(result["rank 5"], np.stack([x, -x], -1))
    np.testing.assert_allclose(jax.grad(lambda x: jnp.sum(map_rows(jnp.sin, x, rows)))(x), np.cos(x), atol=1e-6)


class Pairs(nn.Module):
    """A first layer from features, and the layers after it."""

    widths: tuple[int, ...]
    compute: ComputeConfig

    @nn.compact
    def __call__(self, f, g, train):
        pairs = PairLayer(self.widths[0], compute=self.compute)(f, g)
        return PairNetwork(self.widths, pooled=True, compute=self.compute)(pairs, train=train)


def pair_program(points, targets, train, widths, rows):
    """Trace the layers over pairs in evaluation, or in training with all derivatives."""
    module = Pairs(widths, ComputeConfig(kernels="fast", rows=rows))
    inputs = [jax.ShapeDtypeStruct((2, n, 5), jnp.float32) for n in (points, targets)]
    variables = jax.eval_shape(partial(module.init, train=False), jax.random.key(0), *inputs)
    if not train:
        return jax.make_jaxpr(partial(module.apply, train=False))(variables, *inputs)

    def loss(variables, f, g):
        outputs, _ = module.apply(variables, f, g, True, mutable=["batch_stats"])
        return sum(map(jnp.sum, outputs))

    return jax.make_jaxpr(jax.grad(loss, argnums=(0, 1, 2)))(variables, *inputs)


@pytest.mark.parametrize("train", [False, True])
def test_layers_over_383_points_cost_as_much_as_over_384(train):
    programs = [pair_program(points, 50, train, (8, 6, 4), rows=64) for points in (383, 384)]
    operations = [products_of(program).operations for program in programs]
    assert operations[0] <= operations[1] < 1.01 * operations[0]
    steps = [loop_steps(program) for program in programs]
    assert steps[0] == steps[1] >= 6


@pytest.mark.parametrize(("train", "widths"), [(False, (16, 16, 16)), (True, (16, 2))])
def test_layers_over_pairs_never_hold_the_first_layer_s_values_of_all_pairs(train, widths):
    values = 2 * N * M * 16
    assert largest_array(pair_program(N, M, train, widths, rows=ROWS)) < values / 2
    assert largest_array(pair_program(N, M, train, widths, rows=0)) >= values


def test_the_best_target_never_holds_the_channels_of_all_pairs():
    inputs = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((2, 32), (32,), (1, N, M), (1, N, M))]

    def program(compute):
        return jax.make_jaxpr(jax.grad(lambda *x: jnp.sum(best_target(*x, compute)), argnums=(0, 1, 2, 3)))(*inputs)

    assert largest_array(program(ComputeConfig(kernels="fast", rows=ROWS))) < N * M * 32 / 2
    assert largest_array(program(ComputeConfig(kernels="plain", rows=ROWS))) >= N * M * 32


def encode(compute, x):
    """Encode in training, with parameters that are constants."""
    encoder = PointEncoder(4, (4, 3), 4, compute)
    shapes = jax.eval_shape(partial(encoder.init, train=False), jax.random.key(0), (x,))
    variables = jax.tree.map(lambda s: normal(*s.shape, seed=s.size), shapes)
    return encoder.apply(variables, (x,), train=True, mutable=["batch_stats"])


def overlapping(active, compute, f, g):
    return overlap(f, g, jnp.arange(N) % 3 == 0, jnp.arange(M) % 2 == 0, (1.0, 2.0), active, compute.rows)


IN_ROWS = {
    "point encoder in training": (encode, ((1, N, 3),)),
    "overlap loss": (partial(overlapping, False), ((N, 4), (M, 4))),
    "overlap loss, active mean": (partial(overlapping, True), ((N, 4), (M, 4))),
    "neighbours": (lambda compute, x: knn(x, 4, compute), ((N, 3),)),
    "attention": (lambda compute, q, k, v: attend(q, k, v, compute), ((N, 4), (M, 4), (M, 4))),
    "nearest points": (lambda compute, x, y: nearest(x, y, compute.rows), ((N, 3), (M, 3))),
}


IN_BOTH = ("point encoder in training", "attention")


@pytest.mark.parametrize(("name", "kernels"), [*((name, "fast") for name in IN_ROWS), *((name, "plain") for name in IN_BOTH)])
def test_rows_keep_the_distances_of_all_points_out_of_the_program_and_change_no_number(name, kernels):
    function, shapes = IN_ROWS[name]
    with jax.enable_x64(True):
        arrays = [normal(*shape, seed=seed) for seed, shape in enumerate(shapes)]

        def run(rows, *arrays):
            outputs = function(ComputeConfig(kernels=kernels, rows=rows), *arrays)
            real = [x for x in jax.tree.leaves(outputs) if jnp.issubdtype(x.dtype, jnp.floating)]
            return sum((jnp.sum(jnp.sin(x)) for x in real), jnp.zeros(())), outputs

        def with_derivatives(rows):
            return jax.value_and_grad(partial(run, rows), argnums=tuple(range(len(arrays))), has_aux=True)

        programs = [jax.make_jaxpr(with_derivatives(rows))(*arrays) for rows in (ROWS, 0)]
        assert largest_array(programs[0]) < N * N / 4
        assert largest_array(programs[1]) >= N * N
        found, expected = (jax.jit(with_derivatives(rows))(*arrays) for rows in (ROWS, 0))
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-10), found, expected)
