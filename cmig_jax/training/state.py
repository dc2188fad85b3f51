"""The state of a training, and the step that changes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array
from jax.sharding import Mesh

from cmig_jax.compilation import compile_quickly, less_memory
from cmig_jax.config import Config
from cmig_jax.devices import replicated, sharing, split
from cmig_jax.models.base import initial_variables
from cmig_jax.models.networks import model_of
from cmig_jax.structs import Batch

Step = Callable[["TrainState", Batch, Array], tuple["TrainState", dict[str, Array]]]


@struct.dataclass
class TrainState:
    """What a run needs to continue: the step's number, parameters, running statistics, Adam's moments.

    Random keys are functions of the run's seed and the step, so they are not stored.
    """

    step: Array
    params: Any
    batch_stats: Any
    opt_state: Any

    @property
    def variables(self) -> dict[str, Any]:
        """The network's variables, as `apply` takes them."""
        return {"params": self.params, "batch_stats": self.batch_stats}


def build(config: Config) -> nn.Module:
    """Build the network of a config."""
    return model_of(config.model).build(config.model, config.compute)


def create_state(module: nn.Module, optimizer: optax.GradientTransformation, config: Config, mesh: Mesh) -> TrainState:
    """Initialise a state on every device of the mesh."""
    # Under jit with the sharding of the result: a device_put could alias arrays that the step donates.
    options: dict[str, Any] = {"out_shardings": replicated(mesh), "compiler_options": compile_quickly()}
    return jax.jit(lambda key: _initial(module, optimizer, config, key), **options)(jax.random.key(config.seed))


def abstract_state(module: nn.Module, optimizer: optax.GradientTransformation, config: Config, mesh: Mesh) -> TrainState:
    """Describe the state by shapes, types and placement, without making it."""
    shapes = jax.eval_shape(lambda key: _initial(module, optimizer, config, key), jax.random.key(config.seed))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=replicated(mesh)), shapes)


def state_of(variables: dict[str, Any], optimizer: optax.GradientTransformation) -> TrainState:
    """Return the state of a run that starts from some variables."""
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=variables["params"],
        batch_stats=variables["batch_stats"],
        opt_state=optimizer.init(variables["params"]),
    )


def _initial(module: nn.Module, optimizer: optax.GradientTransformation, config: Config, key: Array) -> TrainState:
    return state_of(initial_variables(module, config.model.needs, key), optimizer)


def make_step(module: nn.Module, optimizer: optax.GradientTransformation, config: Config, mesh: Mesh) -> Step:
    """Make the training step for one global batch: (state, batch, the run's random key) -> (state, scalars).

    The key is an argument, so that runs that differ in their seed share a compiled step. The state is donated. The scalars are the
    total `loss`, every loss term and `gradient_norm`; if they are not finite, the state is returned unchanged except for its step, so
    that it can be inspected.
    """
    model = model_of(config.model)

    def loss_function(params: Any, state: TrainState, batch: Batch, key: Array) -> tuple[Array, tuple[dict[str, Array], Any]]:
        variables = {"params": params, "batch_stats": state.batch_stats}
        prediction, updates = module.apply(variables, batch, train=True, key=key, mutable=["batch_stats"])
        terms = model.losses(prediction, batch, config.model, config.compute)
        return jnp.sum(jnp.stack(list(terms.values()))), (terms, updates.get("batch_stats", {}))

    def step(state: TrainState, batch: Batch, key: Array) -> tuple[TrainState, dict[str, Array]]:
        key = jax.random.fold_in(key, state.step)
        with sharing(mesh):
            (loss, (terms, batch_stats)), gradient = jax.value_and_grad(loss_function, has_aux=True)(state.params, state, batch, key)
        norm = optax.tree.norm(gradient)
        updates, opt_state = optimizer.update(gradient, state.opt_state, state.params)
        changed = TrainState(
            step=state.step, params=optax.apply_updates(state.params, updates), batch_stats=batch_stats, opt_state=opt_state
        )
        finite = jnp.isfinite(loss) & jnp.isfinite(norm)
        kept = jax.tree.map(lambda new, old: jnp.where(finite, new, old), changed, state)
        return kept.replace(step=state.step + 1), {"loss": loss, **terms, "gradient_norm": norm}

    shardings = {"in_shardings": (replicated(mesh), split(mesh), None), "out_shardings": replicated(mesh)}
    return jax.jit(step, donate_argnums=0, compiler_options=less_memory(), **shardings)
