"""What training, inference, evaluation and benchmarks know of a network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig, ModelFlags, Needs
from cmig_jax.structs import Batch, Prediction
from cmig_jax.transform import RigidTransform


@dataclass(frozen=True)
class Model:
    """A kind of network.

    Attributes:
        flags: its flags, a frozen dataclass that inherits from `ModelFlags`; names and needs stand there.
        build: makes the linen module of some flags. The module is called as `module(batch, train=..., key=...)`, where `key` is a random
            key (None in evaluation), and returns a `Prediction` or a subclass; running statistics are in the collection `batch_stats`.
        losses: scalars by name, from (prediction, batch, flags, compute); their plain sum is what training minimises.
        stages: parts of the network that a benchmark times alone, or None. From (module, variables, batch, train) it returns by name a
            function of (module, *inputs) and its inputs.
    """

    flags: type[ModelFlags]
    build: Callable[[Any, ComputeConfig], nn.Module]
    losses: Callable[[Any, Batch, Any, ComputeConfig], dict[str, Array]]
    stages: Callable[[nn.Module, Any, Batch, bool], dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]] | None = None

    @property
    def name(self) -> str:
        """Key of the network in `networks.NETWORKS`."""
        return self.flags.network


def predict(module: nn.Module, variables: Any, batch: Batch) -> Prediction:
    """Run a network in evaluation mode."""
    prediction = module.apply(variables, batch, train=False, key=None)
    assert isinstance(prediction, Prediction), f"{type(module).__name__} returned {type(prediction).__name__}, expected a Prediction"
    return prediction


def initial_variables(module: nn.Module, needs: Needs, key: Array) -> dict[str, Any]:
    """Initialise a network: `params`, and `batch_stats`, which is empty for a network without running statistics."""
    variables = module.init(key, smallest_batch(needs), train=True, key=key)
    return {"params": variables["params"], "batch_stats": variables.get("batch_stats", {})}


def smallest_batch(needs: Needs) -> Batch:
    """Return the smallest training batch that a network accepts: its parameters depend on no number of pairs, points or pixels."""
    points, (sets, count) = max(needs.points, needs.training_points), (2, 6) if needs.axis_views else (1, 1)
    return Batch(
        source=jnp.zeros((1, points, 3)),
        target=jnp.zeros((1, points, 3)),
        views=jnp.zeros((1, sets, count, 32, 32, 1), jnp.uint8) if needs.views else None,
        target_from_source=RigidTransform.identity((1,)),
        source_normals=jnp.zeros((1, points, 3)) if needs.normals else None,
        target_normals=jnp.zeros((1, points, 3)) if needs.normals else None,
    )
