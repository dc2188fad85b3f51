"""Gradient checkpointing changes no number and keeps less. `tests/models/cmignet` has it in a whole network."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.pairs import PairLayer, PairNetwork
from cmig_jax.nn.recompute import call


class Block(nn.Module):
    """Layers over pairs, whose fast version has loops and derivatives of its own, and running statistics."""

    @nn.compact
    def __call__(self, f, g, train):
        compute = ComputeConfig(kernels="fast", rows=7)
        return PairNetwork((5, 4), pooled=True, compute=compute)(PairLayer(5, compute=compute)(f, g), train=train)


def test_recomputing_gives_the_same_gradients_and_statistics_and_keeps_only_inputs_and_outputs(random_variables):
    with jax.enable_x64(True):
        clouds = [np.random.default_rng(seed).normal(size=(2, 20, 3)) for seed in range(2)]
        variables = random_variables(Block(), *clouds, train=False)

        def loss(recompute, params, *clouds):
            method = functools.partial(call, recompute=recompute, train=True)
            outputs, new = Block().apply({**variables, "params": params}, *clouds, method=method, mutable=["batch_stats"])
            return sum(jnp.sum(jnp.sin(x)) for x in outputs), new

        def gradients(recompute):
            return jax.jit(jax.value_and_grad(functools.partial(loss, recompute), (0, 1, 2), has_aux=True))(variables["params"], *clouds)

        def kept(recompute):
            pull = jax.eval_shape(lambda *x: jax.vjp(functools.partial(loss, recompute), *x, has_aux=True)[1], variables["params"], *clouds)
            return sum(x.size for x in jax.tree.leaves(pull))

        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-10), gradients(True), gradients(False))
        numbers = 2 * 20 * 20 + 2 * 20 * 4 + sum(x.size for x in jax.tree.leaves((variables, clouds)))
        assert kept(True) < 1.1 * numbers < kept(False) / 2
