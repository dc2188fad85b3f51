"""Conversion of a network's weights between PyTorch files and run folders, without loss.

A run folder is what `train.py` writes: `config.json` and `checkpoints/`. A converted one also has `pytorch_only.npz`: the tensors that
the Flax network has no place for, and those that its float32 rounds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmig_jax.config import Config, ModelFlags
from cmig_jax.files import replacing
from cmig_jax.inference.load import load
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.parity.cases import Arrays, State
from cmig_jax.parity.cmignet_layout import flags_of_state, layout
from cmig_jax.parity.methods import METHODS
from cmig_jax.parity.torch_files import SUFFIXES, is_torch_file, read_torch, write_torch
from cmig_jax.parity.weights import COUNTER, Layout, to_flax, to_torch
from cmig_jax.training.checkpoint import Checkpoints, write_config
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import state_of

PYTORCH_ONLY = "pytorch_only.npz"


def convert(source: Path, target: Path) -> list[str]:
    """Convert `source` to `target`; each is a PyTorch file (by its suffix) or else a run folder.

    Returns:
        Lines that say what was done.

    Raises:
        ValueError: unreadable, of no network that has a layout, or the target folder exists.
    """
    if not is_torch_file(source):
        if not is_torch_file(target):
            raise ValueError(f"{target}: expected a PyTorch file ({', '.join(SUFFIXES)}), to convert the run folder {source} to")
        return _to_file(source, target)
    flags, state = recognise(read_torch(source))
    if not is_torch_file(target):
        return _to_run(target, flags, state)
    tensors = layout_of(flags)
    to_flax(state, tensors)  # checks it
    write_torch(target, {tensor.name: state[tensor.name] for tensor in tensors})
    return [f"{target}: {len(state)} tensors"]


def layout_of(flags: ModelFlags) -> Layout:
    """Return the tensors of the official `state_dict` of a network.

    Raises:
        ValueError: the network has no official PyTorch form.
    """
    if isinstance(flags, CMIGNetFlags):
        return layout(flags)
    for method in METHODS.values():
        if method.network == flags.network:
            return method.layout(flags)
    raise ValueError(f"network {flags.network}: expected cmignet, or one of {', '.join(sorted({m.network for m in METHODS.values()}))}")


def recognise(state: State) -> tuple[ModelFlags, Arrays]:
    """Find the network that a state belongs to, by the names and shapes of its tensors.

    Returns:
        The network's flags, and the state with the counters of BatchNorm, which old files lack, as zeros.

    Raises:
        ValueError: it belongs to none; the message has the faults of the most similar one.
    """
    candidates, faults = [], []
    for flags_of in (flags_of_state, *(method.flags_of_state for method in METHODS.values())):
        try:
            flags = flags_of(state)
            names = {tensor.name for tensor in layout_of(flags)}
        except (ValueError, KeyError) as error:
            faults.append(error)
            continue
        candidates.append((len(names & set(state)) / len(names | set(state)), flags))
    if not candidates:
        raise ValueError(f"this state is of no known network: {faults[0]}; it has {', '.join(list(state)[:8])}, ...")
    _, flags = max(candidates, key=lambda candidate: candidate[0])
    counters = {tensor.name: np.zeros((), np.int64) for tensor in layout_of(flags) if tensor.name.endswith(COUNTER)}
    return flags, {**counters, **state}


def _to_run(run: Path, flags: ModelFlags, state: State) -> list[str]:
    """Write a run folder whose one checkpoint holds the weights, after step 0."""
    if run.exists():
        raise ValueError(f"{run}: expected a new folder, this one exists")
    config, (variables, beside) = Config(name=flags.network, model=flags), to_flax(state, layout_of(flags))
    exact = {name: value for name, value in state.items() if value.dtype != np.float32}
    write_config(run, config)
    checkpoints, rounded = Checkpoints(run), jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), variables)
    checkpoints.save(0, state_of(rounded, optimizer(config.optim, 1)), iterator={})
    checkpoints.close()
    kept: dict[str, Any] = beside | exact
    with replacing(run / PYTORCH_ONLY) as file:
        np.savez(file, **kept)
    unused = [name for name in beside if not name.endswith(COUNTER)]
    lines = [f"{run}: a run folder of {flags.title}"]
    if unused:
        lines.append(f"never used by the network, kept in {PYTORCH_ONLY} for the way back: {', '.join(unused)}")
    if counters := len(beside) - len(unused):
        lines.append(f"{counters} counters {COUNTER} kept there too")
    return lines


def _to_file(run: Path, path: Path) -> list[str]:
    """Write a state file. A tensor that training did not change gets back the value that was converted, unrounded."""
    network, kept = load(run), {}
    tensors = layout_of(network.config.model)
    if (run / PYTORCH_ONLY).exists():
        with np.load(run / PYTORCH_ONLY, allow_pickle=False) as file:
            kept = {name: file[name] for name in file.files}
    placed = {tensor.name for tensor in tensors if tensor.path}
    beside = {name: value for name, value in kept.items() if name not in placed}
    state, filled = to_torch(jax.device_get(network.variables), tensors, beside)
    for name in placed & set(kept):
        if np.array_equal(kept[name].astype(np.float32), state[name], equal_nan=True):
            state[name] = kept[name]
    write_torch(path, state)
    return [f"{path}: {len(state)} tensors"] + ([f"filled with zeros, as JAX has none: {', '.join(filled)}"] if filled else [])
