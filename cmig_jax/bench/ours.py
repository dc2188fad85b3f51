"""The Flax network of a case, compiled: inference and the training step, whole and by stage."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.allocator import return_freed_memory
from cmig_jax.bench.cases import Arrays, Case
from cmig_jax.bench.products import product_rate, products_of
from cmig_jax.compilation import finished
from cmig_jax.config import ComputeConfig, Config
from cmig_jax.nn.build import build
from cmig_jax.nn.cmignet import CMIGNet, _gather
from cmig_jax.parity.recorded import named_weights
from cmig_jax.parity.sizes import released
from cmig_jax.parity.twin_run import state_shapes
from cmig_jax.parity.weights import to_flax
from cmig_jax.structs import Batch, Prediction, RigidTransform
from cmig_jax.training.mesh import device_mesh
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import TrainState, make_step

Work = Callable[[], Any]


class GivenImages(nn.Module):
    """Stands where the image encoder does: its views `[B, S, V, 1, 1, C]` are the tokens already."""

    def __call__(self, views: Array, *, train: bool) -> Array:
        """Return `[B, S, V, C]`."""
        del train
        return views[..., 0, 0, :]


class Ours:
    """Our network on a case's inputs.

    Attributes:
        compile_seconds: tracing and compilation (or reading from the persistent cache), by what was compiled.
        costs: operations and bytes of products, and the bytes that are held while it runs, by what was compiled.
    """

    def __init__(self, case: Case, arrays: Arrays, compute: ComputeConfig | None = None, seed: int = 0) -> None:
        self.config: Config = replace(released(case.sizes), compute=compute or ComputeConfig())
        self.model: CMIGNet = build(self.config)
        views = arrays.views[:, None, ..., None]
        variables = to_flax(named_weights(state_shapes(case.sizes), seed), case.sizes).variables
        if not case.images:
            self.model = self.model.clone(views=GivenImages())  # pyright: ignore[reportArgumentType]
            views = arrays.image_features[:, None, None, None, None]
            variables = {kind: {name: tree for name, tree in flat.items() if name != "views"} for kind, flat in variables.items()}
        self.variables = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), variables)
        self.batch = Batch(
            source=jnp.asarray(arrays.source),
            target=jnp.asarray(arrays.target),
            views=jnp.asarray(views),
            target_from_source=RigidTransform(jnp.asarray(arrays.R), jnp.asarray(arrays.t)),
        )
        self.images = case.images
        self.compile_seconds: dict[str, float] = {}
        self.costs: dict[str, dict[str, float]] = {}

    def inference(self) -> Work:
        """Compile the pose of the batch."""

        def poses(variables: Any, batch: Batch) -> RigidTransform:
            prediction = self.model.apply(variables, batch, train=False)
            assert isinstance(prediction, Prediction)
            return prediction.target_from_source

        return self._compiled("inference", jax.jit(poses), (self.variables, replace(self.batch, target_from_source=None)))

    def training(self) -> Work:
        """Compile the training step; each call takes one."""
        rule, mesh = optimizer(self.config.optim, 1000), device_mesh(len(self.batch.source), 1)
        state = TrainState(
            step=jnp.zeros((), jnp.int32),
            params=jax.tree.map(jnp.copy, self.variables["params"]),  # the step donates its state
            batch_stats=jax.tree.map(jnp.copy, self.variables["batch_stats"]),
            opt_state=rule.init(self.variables["params"]),
        )
        key = jax.random.key(0)
        step = self._program("training", make_step(self.model, rule, self.config, mesh), (state, self.batch, key))

        def work() -> Array:
            nonlocal state
            state, scalars = step(state, self.batch, key)
            return finished(scalars)["loss"]

        return work

    def stages(self, train: bool, only: str | None = None) -> dict[str, Work]:
        """Compile each stage alone, fed what the stage before gives in evaluation; in training, forward and derivative."""
        prediction: Any = jax.jit(lambda v, b: self.model.apply(v, b, train=False))(self.variables, self.batch)
        source, target = prediction.source_features, prediction.target_features
        fused, chosen = (prediction.source_fused, prediction.target_fused), prediction.keypoints
        tokens = prediction.image_features[:, :, None]
        keypoints = (
            _gather(self.batch.source, fused[0], chosen.source_index),
            _gather(self.batch.target, fused[1], chosen.target_index),
        )
        calls: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
            "point_encoder": (lambda m: m._encode(self.batch.source, self.batch.target, train), ()),
            "fusion": (lambda m, *x: m._fuse(*x), (source, target, tokens)),
            "scores": (lambda m, *x: m._scores(*x), fused),
            "matching": (lambda m, *x: _similarities(m._register(*x, train)[0]), keypoints),
        }
        if self.images:
            calls["image_encoder"] = (lambda m: m._view_tokens(self.batch, train), ())
        return {name: self._stage(name, call, inputs, train) for name, (call, inputs) in calls.items() if only in (None, name)}

    def product_rate(self) -> float:
        """Measure how many operations per second a large product takes in the type of the layers."""
        return product_rate(jnp.dtype(self.config.compute.precision))

    def peak_bytes(self) -> int:
        """Return the most memory that the device held; 0 where JAX does not say."""
        return int((jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0))

    def _stage(self, name: str, call: Callable[..., Any], inputs: tuple[Any, ...], train: bool) -> Work:
        def total(params: Any, inputs: Any) -> Any:
            variables = {**self.variables, "params": params}
            outputs, new = self.model.apply(variables, *inputs, method=call, mutable=["batch_stats"])
            return sum(jnp.sum(x) for x in jax.tree.leaves(outputs)), (outputs, new["batch_stats"])

        run = jax.jit(jax.grad(total, (0, 1), has_aux=True) if train else lambda p, x: total(p, x)[1][0])
        return self._compiled(f"{'training' if train else 'inference'}.{name}", run, (self.variables["params"], inputs))

    def _compiled(self, name: str, function: Any, arguments: tuple[Any, ...]) -> Work:
        program = self._program(name, function, arguments)
        return lambda: finished(program(*arguments))

    def _program(self, name: str, function: Any, arguments: tuple[Any, ...]) -> Any:
        """Compile a `jax.jit` function for these arguments, and note what that took and what its products come to."""
        start = time.perf_counter()
        traced = function.trace(*arguments)
        program = traced.lower().compile()
        self.compile_seconds[name] = time.perf_counter() - start
        return_freed_memory()
        memory = program.memory_analysis()
        buffers = 0 if memory is None else memory.temp_size_in_bytes + memory.argument_size_in_bytes
        self.costs[name] = {**asdict(products_of(traced.jaxpr)), "buffers": buffers}
        return program


def _similarities(iterations: Any) -> list[Array]:
    return [x for iteration in iterations for x in (iteration.match, iteration.logit)]
