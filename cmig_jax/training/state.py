"""What training changes, and the step that changes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import Array
from jax.sharding import Mesh

from cmig_jax.compilation import briefly, frugal
from cmig_jax.config import Config
from cmig_jax.losses import losses
from cmig_jax.nn.cmignet import CMIGNet
from cmig_jax.structs import Batch, Prediction, RigidTransform
from cmig_jax.training.mesh import replicated, sharing, split

Step = Callable[["TrainState", Batch, Array], tuple["TrainState", dict[str, Array]]]


@struct.dataclass
class TrainState:
    """Everything a run needs to go on: the step's number, parameters, running statistics, Adam's moments.

    Random keys are functions of the run's seed and the step, so they need no place here.
    """

    step: Array
    params: Any
    batch_stats: Any
    opt_state: Any

    @property
    def variables(self) -> dict[str, Any]:
        """The network's variables, as `apply` takes them."""
        return {"params": self.params, "batch_stats": self.batch_stats}


def create_state(model: CMIGNet, optimizer: optax.GradientTransformation, config: Config, mesh: Mesh) -> TrainState:
    """Initialise a state on every device of the mesh."""
    # Under jit with the sharding of the result: a device_put could alias arrays that the step donates.
    create = jax.jit(lambda key: _initial(model, optimizer, config, key), out_shardings=replicated(mesh), compiler_options=briefly())
    return create(jax.random.key(config.seed))


def abstract_state(model: CMIGNet, optimizer: optax.GradientTransformation, config: Config, mesh: Mesh) -> TrainState:
    """Describe the state by shapes, types and placement, without making it."""
    shapes = jax.eval_shape(lambda key: _initial(model, optimizer, config, key), jax.random.key(config.seed))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=replicated(mesh)), shapes)


def _initial(model: CMIGNet, optimizer: optax.GradientTransformation, config: Config, key: Array) -> TrainState:
    variables = model.init(key, smallest_batch(config), train=True, key=key)
    return TrainState(
        step=jnp.zeros((), jnp.int32),
        params=variables["params"],
        batch_stats=variables["batch_stats"],
        opt_state=optimizer.init(variables["params"]),
    )


def smallest_batch(config: Config) -> Batch:
    """Return the smallest batch that the network takes; parameters do not depend on numbers of pairs, points or pixels."""
    points = max(config.model.points.k, config.model.keypoints.count)
    sets = 2 if config.views.of == "both" else 1
    return Batch(
        source=jnp.zeros((1, points, 3)),
        target=jnp.zeros((1, points, 3)),
        views=jnp.zeros((1, sets, 1, 32, 32, 1), jnp.uint8),
        target_from_source=RigidTransform.identity((1,)),
    )


def make_step(model: CMIGNet, optimizer: optax.GradientTransformation, config: Config, mesh: Mesh) -> Step:
    """Compile-once training step for one global batch: (state, batch, the run's random key) -> (state, scalars).

    The key is an argument, so that runs that differ in their seed share a compiled step. The state is donated. The scalars are the
    total `loss`, every loss term and `gradient_norm`; where they are not finite the state is returned unchanged but for its step, so
    that it can be inspected.
    """

    def loss_function(params: Any, state: TrainState, batch: Batch, key: Array) -> tuple[Array, tuple[dict[str, Array], Any]]:
        prediction, updates = model.apply(
            {"params": params, "batch_stats": state.batch_stats}, batch, train=True, key=key, mutable=["batch_stats"]
        )
        assert isinstance(prediction, Prediction)
        terms = losses(prediction, batch, config.loss)
        return jnp.sum(jnp.stack(list(terms.values()))), (terms, updates["batch_stats"])

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
    return jax.jit(step, donate_argnums=0, compiler_options=frugal(), **shardings)
