"""Our network of a case, compiled: inference and the training step, whole and by stage."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.bench.cases import Case, make_arrays
from cmig_jax.bench.products import products_of
from cmig_jax.config import ComputeConfig, Config
from cmig_jax.devices import device_mesh
from cmig_jax.models.base import predict
from cmig_jax.models.networks import model_of
from cmig_jax.structs import Batch
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import build, make_step, state_of
from cmig_jax.transform import RigidTransform

Work = Callable[[], Any]


class Ours:
    """Our network on a case's inputs.

    Attributes:
        compile_seconds: tracing and compilation (or reading from the persistent cache), by what was compiled.
        costs: operations and bytes of products, and the bytes that are held while it runs, by what was compiled.
    """

    def __init__(self, case: Case, compute: ComputeConfig) -> None:
        self.config = Config(name="bench", model=case.flags, compute=compute)
        self.module, arrays = build(self.config), make_arrays(case)
        self.variables = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), case.variables())
        self.batch = Batch(
            source=jnp.asarray(arrays.source),
            target=jnp.asarray(arrays.target),
            views=jnp.asarray(arrays.views[:, None, ..., None] if case.images else arrays.views[:, None, None]),
            target_from_source=RigidTransform(jnp.asarray(arrays.R), jnp.asarray(arrays.t)),
        )
        self.compile_seconds: dict[str, float] = {}
        self.costs: dict[str, dict[str, float]] = {}

    def inference(self) -> Work:
        """Compile the pose of the batch."""
        poses = jax.jit(lambda variables, batch: predict(self.module, variables, batch).target_from_source)
        return self._work("inference", poses, (self.variables, replace(self.batch, target_from_source=None)))

    def training(self) -> Work:
        """Compile the training step; each call takes one."""
        rule, mesh = optimizer(self.config.optim, 1000), device_mesh(len(self.batch.source), 1)
        state, key = state_of(jax.tree.map(jnp.copy, self.variables), rule), jax.random.key(0)  # the step donates its state
        step = self._compile("training", make_step(self.module, rule, self.config, mesh), (state, self.batch, key))

        def work() -> Array:
            nonlocal state
            state, scalars = step(state, self.batch, key)
            return jax.block_until_ready(scalars)["loss"]

        return work

    def stages(self, train: bool) -> dict[str, Work]:
        """Compile each part of the network alone; in training, forward and derivative."""
        stages = model_of(self.config.model).stages
        assert stages is not None, f"{self.config.model.network} has no stages"
        parts = stages(self.module, self.variables, self.batch, train)
        return {name: self._stage(name, call, inputs, train) for name, (call, inputs) in parts.items()}

    def peak_bytes(self) -> int:
        """Return the most memory that the device held; 0 where JAX does not say."""
        return int((jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0))

    def _stage(self, name: str, call: Callable[..., Any], inputs: tuple[Any, ...], train: bool) -> Work:
        def total(params: Any, inputs: Any) -> Any:
            variables = {**self.variables, "params": params}
            outputs, new = self.module.apply(variables, *inputs, method=call, mutable=["batch_stats"])
            return sum(jnp.sum(x) for x in jax.tree.leaves(outputs)), (outputs, new)

        run = jax.jit(jax.grad(total, (0, 1), has_aux=True) if train else lambda p, x: total(p, x)[1][0])
        return self._work(f"{'training' if train else 'inference'} {name}", run, (self.variables["params"], inputs))

    def _work(self, name: str, function: Any, arguments: tuple[Any, ...]) -> Work:
        program = self._compile(name, function, arguments)
        return lambda: jax.block_until_ready(program(*arguments))

    def _compile(self, name: str, function: Any, arguments: tuple[Any, ...]) -> Any:
        """Compile a `jax.jit` function for these arguments, and note what that took and what its products come to."""
        start = time.perf_counter()
        traced = function.trace(*arguments)
        program = traced.lower().compile()
        self.compile_seconds[name] = time.perf_counter() - start
        memory = program.memory_analysis()
        buffers = 0 if memory is None else memory.temp_size_in_bytes + memory.argument_size_in_bytes
        self.costs[name] = {**asdict(products_of(traced.jaxpr)), "buffers": buffers}
        return program
