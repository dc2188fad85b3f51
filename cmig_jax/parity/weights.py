"""Weights both ways between a PyTorch `state_dict` of the released network and Flax variables, without loss.

A state is a dict of numpy arrays under PyTorch names and layouts; variables are `{"params": ..., "batch_stats": ...}` of numpy
arrays. What the Flax network has no place for (parameters that the released network never uses, `num_batches_tracked`) travels
beside the variables, so that the way back gives every tensor again. Numbers keep their type.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from flax import traverse_util
from numpy.typing import NDArray

from cmig_jax.parity.layout import places
from cmig_jax.parity.recorded import Arrays
from cmig_jax.parity.sizes import Sizes
from cmig_jax.parity.twin_run import state_shapes

UNUSED = ("significance_fc.", "MVCNN.fc.", "head.")


@dataclass(frozen=True)
class Converted:
    """A state in Flax form.

    Attributes:
        variables: `params` and `batch_stats`, nested, for the network that `build` makes.
        kept: tensors without a place there, by PyTorch name.
    """

    variables: dict[str, Any]
    kept: Arrays

    @property
    def unused(self) -> list[str]:
        """Names of the parameters and statistics of layers that the released network never uses."""
        return [name for name in self.kept if name.startswith(UNUSED)]


def to_flax(state: Mapping[str, NDArray], sizes: Sizes) -> Converted:
    """Convert a state to Flax variables.

    Raises:
        ValueError: tensors are missing, surplus or of another shape; all of them are named.
    """
    shapes = state_shapes(sizes)
    _raise("this state is not the released network's", _differences({name: np.shape(value) for name, value in state.items()}, shapes))
    table = {place.name: place for place in places(sizes)}
    flat = {place.path: place.to_flax(np.asarray(state[name])) for name, place in table.items()}
    return Converted(traverse_util.unflatten_dict(flat), {name: np.asarray(state[name]) for name in shapes if name not in table})


def to_torch(variables: Mapping[str, Any], sizes: Sizes, kept: Mapping[str, NDArray] | None = None) -> tuple[Arrays, list[str]]:
    """Convert Flax variables to a state, in the order of the released one.

    Args:
        variables: of the network that `build` makes for the released settings.
        sizes: of that network.
        kept: what `to_flax` kept beside the variables; a network that never was a PyTorch one has none.

    Returns:
        the state, and the names of the tensors that had to be filled in with zeros (unused parameters, counters).

    Raises:
        ValueError: variables are missing, surplus or of another shape; all of them are named.
    """
    shapes, kept = state_shapes(sizes), kept or {}
    table = {place.path: place for place in places(sizes)}
    flat = {path: np.asarray(value) for path, value in traverse_util.flatten_dict(dict(variables)).items()}
    expected = {"/".join(path): place.to_flax(np.empty(shapes[place.name], np.bool_)).shape for path, place in table.items()}
    problems = _differences({"/".join(path): value.shape for path, value in flat.items()}, expected)
    problems += _differences({name: np.shape(value) for name, value in kept.items()}, {name: shapes.get(name) for name in kept})
    _raise("these variables are not the released network's", problems)
    state = {place.name: place.to_torch(flat[path]) for path, place in table.items()}
    state |= {name: np.asarray(value) for name, value in kept.items()}
    filled = [name for name in shapes if name not in state]
    state |= {name: np.zeros(shapes[name], np.int64 if name.endswith("num_batches_tracked") else np.float32) for name in filled}
    return {name: state[name] for name in shapes}, filled


def by_torch_name(tree: Mapping[str, Any], sizes: Sizes) -> Arrays:
    """Give the leaves of variables, or of a tree like them (gradients under `params`), PyTorch names and layouts."""
    flat = traverse_util.flatten_dict(dict(tree))
    return {place.name: place.to_torch(np.asarray(flat[place.path])) for place in places(sizes) if place.path in flat}


def sizes_of_state(state: Mapping[str, NDArray]) -> Sizes:
    """Read the sizes off names and shapes; what leaves no trace there (k, K, the number of attention heads) is as released.

    Raises:
        ValueError: this cannot be the state of such a network.
    """

    def widths(pattern: str, first: int = 0) -> tuple[int, ...]:
        """Return the output channels of the series of tensors that `pattern` names, counted up from `first`."""
        found = []
        while (value := state.get(pattern.format(first + len(found)))) is not None and np.ndim(value) > 0:
            found.append(np.shape(value)[0])
        if not found:
            raise ValueError(f"this state is not the released network's: missing {pattern.format(first)}")
        return tuple(found)

    points, image = widths("emb_nn.conv{}.weight", 1), widths("MVCNN.net.{}.0.conv1.weight", 4)
    return Sizes(
        widths=points[:-1],
        dim=points[-1],
        image_widths=image,
        image_blocks=tuple(len(widths(f"MVCNN.net.{stage}.{{}}.conv1.weight")) for stage in range(4, 4 + len(image))),
        feed_forward=widths("attn.model.encoder.layers.0.feed_forward.w_{}.weight", 1)[0],
        iterations=len(widths("preweight.{}.conv.0.weight")),
        feature_widths=widths("sim_mat_Fconv.0.conv.{}.conv.weight"),
        coordinate_widths=widths("sim_mat_Sconv.0.conv.{}.conv.weight"),
    )


def _differences(shapes: Mapping[str, tuple[int, ...]], expected: Mapping[str, tuple[int, ...] | None]) -> list[str]:
    problems = [f"missing {name}" for name in expected if name not in shapes]
    for name, shape in shapes.items():
        if expected.get(name) is None:
            problems.append(f"surplus {name}")
        elif shape != expected[name]:
            problems.append(f"{name} has shape {shape}, expected {expected[name]}")
    return problems


def _raise(what: str, problems: list[str]) -> None:
    if problems:
        raise ValueError(f"{what}: {'; '.join(problems)}")
