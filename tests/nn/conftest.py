"""Variables of any module from NumPy: no initialisation to compile, and no BatchNorm that does nothing."""

import jax
import numpy as np
import pytest


@pytest.fixture(scope="session")
def random_like():
    """Give a function from the shapes of a module's variables to random values for them."""

    def draw(shapes, seed=0, dtype=np.float32):
        rng = np.random.default_rng(seed)

        def leaf(path, shape):
            name = path[-1].key
            if name in ("scale", "var"):
                return rng.uniform(0.5, 1.5, shape.shape).astype(dtype)
            fan_in = np.prod(shape.shape[:-1]) if name == "kernel" else 10
            return (rng.normal(size=shape.shape) / np.sqrt(fan_in)).astype(dtype)

        return jax.tree_util.tree_map_with_path(leaf, shapes)

    return draw
