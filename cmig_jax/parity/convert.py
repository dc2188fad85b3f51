"""Convert weights between PyTorch files and run folders."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmig_jax.parity.files import PYTORCH_ONLY, TORCH_SUFFIXES, read_run, read_torch, write_run, write_torch
from cmig_jax.parity.layout import places
from cmig_jax.parity.recorded import Arrays
from cmig_jax.parity.sizes import Sizes, released, sizes_of
from cmig_jax.parity.weights import Converted, sizes_of_state, to_flax, to_torch


def convert(source: Path, target: Path) -> list[str]:
    """Convert `source` to `target`: each is a PyTorch file (by its suffix) or else a run folder.

    Returns:
        lines that say what was done.

    Raises:
        ValueError: unreadable, not the released network, or the target folder exists.
    """
    if source.suffix in TORCH_SUFFIXES and not source.is_dir():
        state = read_torch(source)
        sizes = sizes_of_state(state)
        converted = to_flax(state, sizes)
        if target.suffix in TORCH_SUFFIXES:
            write_torch(target, state)
            return [f"{target}: {len(state)} tensors"]
        write_run(target, released(sizes), converted.variables, _beside(state, converted, sizes))
        return [f"{target}: a run folder, {sizes.iterations} iterations", *_report(converted)]
    if target.suffix not in TORCH_SUFFIXES:
        raise ValueError(f"{target}: expected a PyTorch file ({', '.join(TORCH_SUFFIXES)}), to convert the run folder {source} to")
    config, variables, extra = read_run(source)
    sizes = sizes_of(config.model)
    placed = {place.name for place in places(sizes)}
    state, filled = to_torch(variables, sizes, {name: value for name, value in extra.items() if name not in placed})
    state |= {name: extra[name] for name in placed & set(extra) if _rounds_to(extra[name], state[name])}
    write_torch(target, state)
    lines = [f"{target}: {len(state)} tensors"]
    return lines + ([f"filled with zeros, since JAX has no such tensor: {', '.join(filled)}"] if filled else [])


def _beside(state: Mapping[str, NDArray], converted: Converted, sizes: Sizes) -> Arrays:
    """Return what the checkpoint's float32 variables cannot give back."""
    exact = {place.name: state[place.name] for place in places(sizes) if state[place.name].dtype != np.float32}
    return converted.kept | exact


def _rounds_to(exact: NDArray, stored: NDArray) -> bool:
    """Say whether a tensor is what was converted, but for rounding (and not what training made of it)."""
    return np.array_equal(exact.astype(np.float32), stored, equal_nan=True)


def _report(converted: Converted) -> list[str]:
    counters = [name for name in converted.kept if name.endswith("num_batches_tracked")]
    unused = [name for name in converted.unused if name not in counters]
    return [
        f"never used by the network, kept in {PYTORCH_ONLY} for the way back: {', '.join(unused)}",
        f"{len(counters)} counters num_batches_tracked kept there too",
    ]
