"""Programs compiled at their first call."""

import jax
import jax.numpy as jnp

from cmig_jax.compilation import compiled_first


def test_a_step_on_a_cpu_returns_once_it_is_done():
    size = 1024

    def step(x):
        matrix = jnp.full((size, size), x)
        for _ in range(8):
            matrix = jax.lax.optimization_barrier(matrix @ matrix) / size
        return jnp.sum(matrix)

    call = compiled_first(jax.jit(step))
    for x in (1.0, 0.5):
        assert call(jnp.asarray(x)).is_ready()
