"""Twin against Flax, live: same weights, same inputs, float64.

Forward in evaluation and training mode, every loss term, every gradient element, running statistics, and parameters and statistics
after steps of Adam with weight decay.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import torch
from numpy.typing import NDArray

from cmig_jax.config import Config, OptimConfig
from cmig_jax.parity.flax_run import make_batch, make_pass, run_flax, source_index
from cmig_jax.parity.recorded import Arrays, Inputs, Run
from cmig_jax.parity.rows import OUTPUT_BOUND, STATE_BOUND, Row, compare
from cmig_jax.parity.sizes import Sizes, released, sizes_of
from cmig_jax.parity.twin import Twin
from cmig_jax.parity.twin_run import make_twin, run_twin
from cmig_jax.parity.weights import by_torch_name, to_flax
from cmig_jax.training.optim import optimizer

STEPS = 3
NO_GRADIENT = 1e-7  # a gradient below this share of the largest is rounding: a bias before a norm or a softmax has none


def compare_live(
    state: Mapping[str, NDArray], sizes: Sizes, inputs: Inputs, margins: tuple[float, float] | None = None, seed: int = 0
) -> list[Row]:
    """Run both networks and compare everything.

    Args:
        state: weights under PyTorch names.
        sizes: of the network.
        inputs: the pairs.
        margins: of the overlap loss; None is off.
        seed: of the training keypoints, which the twin draws.

    Returns:
        rows under `eval/`, `train/`, `gradient/`, `statistics/` and `adam/`.
    """
    config = released(sizes, margins)
    variables = to_flax(state, sizes).variables
    evaluated = run_twin(make_twin(sizes, state, margins=margins), inputs, train=False)
    rows = _outputs("eval", run_flax(config, variables, replace(inputs, src_idx=None), train=False), evaluated)
    trained = run_twin(make_twin(sizes, state, margins=margins), inputs, train=True, seed=seed)
    inputs = replace(inputs, src_idx=trained.outputs["src_idx"])
    ours = run_flax(config, variables, inputs, train=True)
    rows += _outputs("train", ours, trained)
    rows += _state("gradient", ours.gradients, trained.gradients, NO_GRADIENT)
    rows += _state("statistics", ours.buffers, _statistics(trained.buffers))
    twin = make_twin(sizes, state, margins=margins)
    expected = twin_adam(twin, inputs, config.optim)
    return rows + _state("adam", flax_adam(config, variables, inputs), expected)


def twin_adam(twin: Twin, inputs: Inputs, config: OptimConfig, steps: int = STEPS) -> Arrays:
    """Take steps of PyTorch's Adam on one batch; return parameters that the network uses and running statistics."""
    adam = torch.optim.Adam(twin.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    for _ in range(steps):
        run = run_twin(twin, inputs, train=True)
        adam.step()
    parameters = {name: p.detach().numpy().copy() for name, p in twin.named_parameters() if p.grad is not None}
    return parameters | _statistics(run.buffers)


def flax_adam(config: Config, variables: Mapping[str, Any], inputs: Inputs, steps: int = STEPS) -> Arrays:
    """Take steps of our optimizer on one batch, in float64; return parameters and running statistics by PyTorch name."""
    with jax.enable_x64(True):
        trained = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), dict(variables))
        batch, index, run = make_batch(inputs, "float64"), source_index(inputs), make_pass(config, train=True)
        adam = optimizer(config.optim, steps_per_epoch=1000)
        moments = adam.init(trained["params"])
        for _ in range(steps):
            done = run(trained, batch, index)
            updates, moments = adam.update(done.gradients, moments, trained["params"])
            trained = {"params": optax.apply_updates(trained["params"], updates), "batch_stats": done.batch_stats}
        return by_torch_name(trained, sizes_of(config.model))


def summary(rows: list[Row]) -> str:
    """Write one line per group of rows: how many there are, and the worst."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row.key.partition("/")[0], []).append(row)
    lines = []
    for name, members in groups.items():
        failing = sum(not row.holds for row in members)
        worst = max(members, key=lambda row: np.inf if np.isnan(row.relative) else row.relative)
        verdict = f"{failing} FAIL" if failing else "all hold"
        lines.append(f"{name:10}  {len(members):4} rows, {verdict}; largest relative difference {worst.relative:.1e} ({worst.key})")
    return "\n".join(lines)


def _outputs(group: str, ours: Run, theirs: Run) -> list[Row]:
    keys = [key for key in theirs.outputs if key != "src_idx" and not key.startswith("layer_")]
    return [
        compare(f"{group}/{key}", ours.outputs.get(key), theirs.outputs[key], OUTPUT_BOUND, elementwise=key == "loss_terms") for key in keys
    ]


def _state(group: str, ours: Arrays, theirs: Arrays, share: float = 0.0) -> list[Row]:
    floor = share * max(float(np.abs(value).max()) for value in theirs.values())
    return [compare(f"{group}/{name}", ours.get(name), value, STATE_BOUND, floor) for name, value in theirs.items()]


def _statistics(buffers: Arrays) -> Arrays:
    """Leave out the counters, and the statistics of the layers that are never used."""
    return {name: value for name, value in buffers.items() if value.ndim and not name.startswith("significance_fc.")}
