"""The PyTorch twin beside CMIGNet, live: the same weights and inputs, float64.

Forward in evaluation and training mode, every loss term, every gradient element, running statistics, and parameters and statistics
after steps of Adam with weight decay.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import optax
import torch

from cmig_jax.config import ComputeConfig, Config, Kernels, OptimConfig
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.cmignet_check import check
from cmig_jax.parity.cmignet_layout import UNUSED, layout
from cmig_jax.parity.cmignet_run import make_batch, make_pass
from cmig_jax.parity.cmignet_twin import Twin
from cmig_jax.parity.rows import Row, compare_all
from cmig_jax.parity.weights import RUNNING, by_torch_name, to_flax
from cmig_jax.training.optim import optimizer

STEPS = 3
OWN_GROUP = ("gradient/", "statistics/")


def compare_live(state: State, flags: CMIGNetFlags, inputs: Arrays, seed: int = 0, kernels: Kernels = "auto") -> list[Row]:
    """Run both networks and compare everything.

    Args:
        state: weights under PyTorch names.
        flags: of the network, of the released kind.
        inputs: the pairs (`inputs.random_inputs`).
        seed: of the training keypoints, which the twin draws.
        kernels: which version of each of our operations.

    Returns:
        Rows under `eval/`, `train/`, `gradient/`, `statistics/` and `adam/`.
    """
    evaluation = Case(inputs, run_twin(Twin(flags, state), inputs, train=False))
    trained = run_twin(Twin(flags, state), inputs, train=True, seed=seed)
    training = Case({**inputs, "src_idx": trained.pop("src_idx")}, trained)
    rows = [replace(row, key=f"eval/{row.key}") for row in check(evaluation, flags, state, kernels=kernels)]
    for row in check(training, flags, state, kernels=kernels):
        rows.append(row if row.key.startswith(OWN_GROUP) else replace(row, key=f"train/{row.key}"))
    config = Config(name="released", model=flags, compute=ComputeConfig(kernels=kernels))
    theirs, ours = twin_adam(Twin(flags, state), training.inputs, config.optim), flax_adam(config, state, training.inputs)
    return rows + compare_all(theirs, ours, "float64")


def run_twin(twin: Twin, inputs: State, train: bool, seed: int = 0) -> Arrays:
    """Run the twin forward, and in training mode backward; the gradients stay on its parameters.

    Args:
        twin: the network; its running statistics move in training mode.
        inputs: the pairs; without `src_idx`, training keypoints are drawn.
        train: training mode.
        seed: of that draw.

    Returns:
        The results by name (`cases`).
    """
    given = {name: torch.tensor(x, dtype=torch.float64 if x.dtype.kind == "f" else torch.int64) for name, x in inputs.items()}
    for parameter in twin.parameters.values():
        parameter.grad = None
    with torch.set_grad_enabled(train):
        found = twin(given, train, torch.Generator().manual_seed(seed))
    if train:
        found["loss"].backward()
        found |= {f"gradient/{name}": x.grad for name, x in twin.parameters.items() if x.grad is not None}
        used = [name for name in twin.state if name.endswith(RUNNING) and not name.startswith(UNUSED)]
        found |= {f"statistics/{name}": twin.state[name] for name in used}
    return {name: value.detach().numpy().copy() for name, value in found.items()}


def twin_adam(twin: Twin, inputs: Arrays, config: OptimConfig) -> Arrays:
    """Take `STEPS` steps of PyTorch's Adam; return the parameters that the network uses and the statistics, under `adam/`."""
    adam, found = torch.optim.Adam(twin.parameters.values(), lr=config.learning_rate, weight_decay=config.weight_decay), {}
    for _ in range(STEPS):
        found = run_twin(twin, inputs, train=True)
        adam.step()
    names = [key.partition("/")[2] for key in found if key.startswith(OWN_GROUP)]
    return {f"adam/{name}": twin.state[name].detach().numpy() for name in names}


def flax_adam(config: Config, state: State, inputs: Arrays) -> Arrays:
    """Take `STEPS` steps of our optimizer in float64; return parameters and running statistics by PyTorch name, under `adam/`."""
    assert isinstance(config.model, CMIGNetFlags)
    tensors, rule = layout(config.model), optimizer(config.optim, steps_per_epoch=1000)

    @jax.jit
    def step(gradients: Any, moments: Any, params: Any) -> tuple[Any, Any]:
        updates, moments = rule.update(gradients, moments, params)
        return optax.apply_updates(params, updates), moments

    with jax.enable_x64(True):
        variables = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), to_flax(state, tensors)[0])
        moments = jax.jit(rule.init)(variables["params"])
        for _ in range(STEPS):
            gradients, (_, _, statistics) = make_pass(config, True)(variables, *make_batch(inputs, "float64"), {})
            params, moments = step(gradients, moments, variables["params"])
            variables = {"params": params, "batch_stats": statistics}
        return {f"adam/{name}": value for name, value in by_torch_name(variables, tensors).items()}
