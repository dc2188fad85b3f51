"""Weights of any network both ways between a PyTorch `state_dict` and Flax variables, without loss.

A state is a dict of NumPy arrays under PyTorch names and in PyTorch's layout; variables are `{"params": ..., "batch_stats": ...}`. A
layout lists every tensor of the state in its order. Tensors without a place in the variables travel beside them. Types are kept.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from flax import traverse_util
from numpy.typing import NDArray

from cmig_jax.parity.cases import Arrays, State

COUNTER, RUNNING = "num_batches_tracked", ("running_mean", "running_var")


@dataclass(frozen=True)
class Tensor:
    """One tensor of a state.

    Attributes:
        name, shape: in PyTorch.
        path: in the Flax variables, None without a place there.
        spatial: a kernel that keeps its spatial axes; other kernels are linear, or 1x1 convolutions that lose their unit axes.
    """

    name: str
    shape: tuple[int, ...]
    path: tuple[str, ...] | None = None
    spatial: bool = False

    def to_flax(self, value: NDArray) -> NDArray:
        """Reorder a kernel `[out, in, ...]` to Flax's `[..., in, out]`."""
        if self.path is None or self.path[-1] != "kernel":
            return value
        return np.ascontiguousarray(value.transpose(2, 3, 1, 0) if self.spatial else value.reshape(value.shape[:2]).T)

    def to_torch(self, value: NDArray) -> NDArray:
        """Undo `to_flax`."""
        if self.path is None or self.path[-1] != "kernel":
            return value
        return np.ascontiguousarray(value.transpose(3, 2, 0, 1) if self.spatial else value.T.reshape(self.shape))


Layout = Sequence[Tensor]


def to_flax(state: State, layout: Layout) -> tuple[dict[str, Any], Arrays]:
    """Convert a state.

    Returns:
        The variables, and the tensors without a place in them, by PyTorch name.

    Raises:
        ValueError: tensors are missing, surplus or of another shape; all of them are named.
    """
    _refuse("this state is not the network's", state, {tensor.name: tensor.shape for tensor in layout})
    placed = {tensor.path: tensor.to_flax(np.asarray(state[tensor.name])) for tensor in layout if tensor.path}
    return traverse_util.unflatten_dict(placed), {tensor.name: np.asarray(state[tensor.name]) for tensor in layout if not tensor.path}


def to_torch(variables: Mapping[str, Any], layout: Layout, beside: State) -> tuple[Arrays, list[str]]:
    """Convert variables.

    Args:
        variables: of the network that the layout belongs to.
        layout: of the state.
        beside: what `to_flax` returned beside the variables; empty for a network that never was a PyTorch one.

    Returns:
        The state, and the names of the tensors that had to be filled with zeros.

    Raises:
        ValueError: variables are missing, surplus or of another shape; all of them are named.
    """
    expected = {"/".join(tensor.path): tensor.to_flax(np.empty(tensor.shape, bool)).shape for tensor in layout if tensor.path}
    expected |= {tensor.name: tensor.shape for tensor in layout if tensor.name in beside and not tensor.path}
    given = {"/".join(path): value for path, value in traverse_util.flatten_dict(dict(variables)).items()}
    _refuse("these variables are not the network's", {**given, **beside}, expected)
    state = {**by_torch_name(variables, layout), **beside}
    empty = {tensor.name: tensor for tensor in layout if tensor.name not in state}
    zeros = {name: np.zeros(tensor.shape, np.int64 if name.endswith(COUNTER) else np.float32) for name, tensor in empty.items()}
    return {tensor.name: (state | zeros)[tensor.name] for tensor in layout}, list(zeros)


def by_torch_name(tree: Mapping[str, Any], layout: Layout) -> Arrays:
    """Give the leaves of variables, or of a tree like them (gradients under `params`), PyTorch names and layouts."""
    flat = traverse_util.flatten_dict(dict(tree))
    return {tensor.name: tensor.to_torch(np.asarray(flat[tensor.path])) for tensor in layout if tensor.path in flat}


def named_weights(layout: Layout, seed: int) -> Arrays:
    """Return the float64 weights of recorded cases: each tensor is a function of its name, its shape and the case's seed."""
    return {tensor.name: _named_weight(tensor.name, tensor.shape, seed) for tensor in layout}


def _named_weight(name: str, shape: tuple[int, ...], seed: int) -> NDArray:
    kind = name.split(".")[-1]
    if kind == COUNTER:
        return np.zeros((), np.int64)
    if kind == "reflect":
        return np.diag([1.0, 1.0, -1.0])
    normal = np.random.default_rng([seed, zlib.crc32(name.encode())]).standard_normal(shape)
    if kind == "running_var":
        return 1 + 0.2 * np.abs(normal)
    if kind in ("running_mean", "bias", "b_2"):
        return 0.1 * normal
    if len(shape) == 1:  # scales of norms
        return 1 + 0.1 * normal
    return normal * np.sqrt(2.0 / np.prod(shape[1:]))  # He, by fan-in


def _refuse(what: str, arrays: Mapping[str, Any], expected: Mapping[str, tuple[int, ...]]) -> None:
    found = {name: np.shape(value) for name, value in arrays.items()}
    faults = [f"missing {name}" for name in expected if name not in found] + [f"surplus {name}" for name in found if name not in expected]
    faults += [f"{name} has shape {found[name]}, expected {shape}" for name, shape in expected.items() if found.get(name, shape) != shape]
    if faults:
        raise ValueError(f"{what}: {'; '.join(faults)}")
