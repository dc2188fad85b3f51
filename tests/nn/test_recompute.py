"""What is computed again for the derivative is what was thrown away. `test_cmignet.py` has how much less a network keeps."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from cmig_jax.nn.matching import CMIGNetHead, KeypointSet
from cmig_jax.nn.recompute import applied


def test_a_module_that_is_computed_again_has_the_same_gradient():
    with jax.enable_x64(True):
        rng = np.random.default_rng(2)
        clouds = [
            KeypointSet(points=jnp.asarray(rng.normal(size=(2, 20, 3))), features=jnp.asarray(rng.normal(size=(2, 20, 8)))) for _ in "ab"
        ]
        head = CMIGNetHead((8, 8), (8,))
        variables = head.init(jax.random.key(0), *clouds, train=True)

        @functools.partial(jax.jit, static_argnums=2)
        def gradient(params, clouds, recompute):
            def loss(params, clouds):
                def call(head):
                    return applied(head, *clouds, recompute=recompute, train=True)

                match, _ = head.apply({**variables, "params": params}, method=call, mutable=["batch_stats"])
                return jnp.sum(jnp.sin(match.feature)) + jnp.sum(jnp.cos(match.coordinate)) + jnp.sum(match.logit**2)

            return jax.grad(loss, (0, 1))(params, clouds)

        kept, again = (gradient(variables["params"], clouds, recompute) for recompute in (False, True))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-10), kept, again)
