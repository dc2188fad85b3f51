"""Run the PyTorch twin on numpy inputs, and record cases with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from cmig_jax.parity.recorded import Arrays, Case, Inputs, Run, condensed, named_weights
from cmig_jax.parity.sizes import Sizes
from cmig_jax.parity.twin import Twin


def make_twin(
    sizes: Sizes, state: Mapping[str, NDArray], dtype: torch.dtype = torch.float64, margins: tuple[float, float] | None = None
) -> Twin:
    """Build a twin with the given weights; names and shapes must be exactly its own."""
    twin = Twin(sizes, margins).to(dtype)
    twin.load_state_dict({name: torch.tensor(value) for name, value in state.items()}, strict=True)
    return twin


def state_shapes(sizes: Sizes) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of the state of a network of these sizes."""
    with torch.device("meta"):
        return {name: tuple(tensor.shape) for name, tensor in Twin(sizes).state_dict().items()}


def run_twin(twin: Twin, inputs: Inputs, train: bool, seed: int = 0) -> Run:
    """Run forward, and in training mode backward; gradients are left on the twin's parameters.

    Args:
        twin: the network; its running statistics move in training mode.
        inputs: the pairs; without `src_idx`, training keypoints are drawn.
        train: training mode.
        seed: of that draw.
    """
    dtype = next(twin.parameters()).dtype
    src, tgt, views, R_gt, t_gt = (torch.tensor(x, dtype=dtype) for x in (inputs.src, inputs.tgt, inputs.views, inputs.R_gt, inputs.t_gt))
    src_idx = None if inputs.src_idx is None else torch.tensor(inputs.src_idx)
    twin.train(train).zero_grad(set_to_none=True)
    with torch.set_grad_enabled(train):
        out = twin(src, tgt, views, R_gt, t_gt, src_idx, torch.Generator().manual_seed(seed))
    gradients: Arrays = {}
    if train:
        for value in out.values():
            if value.requires_grad:
                value.retain_grad()
        out["loss"].backward()
        gradients = {name: p.grad.numpy().copy() for name, p in twin.named_parameters() if p.grad is not None}
    return Run(
        outputs={name: value.detach().numpy().copy() for name, value in out.items()},
        gradients=gradients,
        buffers={name: value.numpy().copy() for name, value in twin.named_buffers()},
        cotangents={name: value.grad.numpy() for name, value in out.items() if value.retains_grad and value.grad is not None},
    )


def record_case(sizes: Sizes, inputs: Inputs, train: bool, seed: int, margins: tuple[float, float] | None = None) -> Case:
    """Record a case in float64 with the weights that `seed` names."""
    twin = make_twin(sizes, named_weights(state_shapes(sizes), seed), margins=margins)
    run = run_twin(twin, inputs, train, seed)
    outputs = {name: value for name, value in run.outputs.items() if not name.startswith("layer_")}
    if not train:
        return Case(replace(inputs, src_idx=None), outputs)
    drawn = outputs.pop("src_idx").astype(np.int32)
    outputs = condensed(outputs)
    outputs |= {f"grad_norm/{name}": np.asarray(np.linalg.norm(value.ravel())) for name, value in run.gradients.items()}
    outputs |= {f"buffer_sum/{name}": np.asarray(value.sum()) for name, value in run.buffers.items() if value.ndim}
    return Case(replace(inputs, src_idx=drawn), outputs)
