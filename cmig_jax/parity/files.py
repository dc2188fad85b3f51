"""PyTorch files and run folders: where weights come from and go to.

A run folder is what `train.py` writes: `config.json` and `checkpoints/`. One that was converted also has `pytorch_only.npz`: the
tensors that the Flax network has no place for, and those that its float32 would round.
"""

from __future__ import annotations

import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import NDArray

from cmig_jax.config import Config
from cmig_jax.nn.build import build
from cmig_jax.parity.recorded import Arrays
from cmig_jax.training.checkpoint import Checkpoints, load_state, read_config, write_config
from cmig_jax.training.mesh import device_mesh
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import TrainState, abstract_state

TORCH_SUFFIXES = (".t7", ".pt", ".pth", ".safetensors")
PYTORCH_ONLY = "pytorch_only.npz"
WRAPPERS = ("state_dict", "model_state_dict", "model")


def read_torch(path: Path) -> Arrays:
    """Read a `state_dict`, taking off `module.` prefixes and the `{"state_dict": ...}` around it.

    Only tensors are read: a pickle that would run code is refused.

    Raises:
        ValueError: no such file, not readable as weights, or something else than tensors in it.
    """
    if path.suffix not in TORCH_SUFFIXES:
        raise ValueError(f"{path}: expected a PyTorch file ({', '.join(TORCH_SUFFIXES)})")
    try:
        if path.suffix == ".safetensors":
            content: Any = safetensors.torch.load_file(path)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about the pickle's protocol, on files that are refused anyway
                content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        reason = str(error).strip().splitlines()[0]
        raise ValueError(f"{path}: refused, since it holds more than tensors or is no PyTorch file ({reason})") from error
    except (OSError, EOFError, RuntimeError, KeyError, zipfile.BadZipFile, safetensors.SafetensorError) as error:
        raise ValueError(
            f"{path}: expected PyTorch weights ({str(error).splitlines()[0] if str(error) else type(error).__name__})"
        ) from error
    state = _unwrap(content)
    foreign = [str(name) for name, value in state.items() if not isinstance(value, torch.Tensor)]
    if foreign or not state:
        raise ValueError(f"{path}: expected a dict of tensors, found other things under {foreign or 'no name at all'}")
    return {str(name): _array(value) for name, value in state.items()}


def write_torch(path: Path, state: Mapping[str, NDArray]) -> None:
    """Write a `state_dict`."""
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}
    if path.suffix == ".safetensors":
        safetensors.torch.save_file(tensors, path)
    else:
        torch.save(tensors, path)


def write_run(run: Path, config: Config, variables: Mapping[str, Any], pytorch_only: Mapping[str, NDArray]) -> None:
    """Write a run folder whose one checkpoint holds `variables`, as step 0.

    Raises:
        ValueError: there is a run already.
    """
    if run.exists():
        raise ValueError(f"{run}: expected a new folder, this one exists")
    write_config(run, config)
    weights = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), dict(variables))
    state = TrainState(
        step=jnp.zeros((), jnp.int32),
        params=weights["params"],
        batch_stats=weights["batch_stats"],
        opt_state=optimizer(config.optim, 1).init(weights["params"]),
    )
    checkpoints = Checkpoints(run)
    checkpoints.save(0, state, iterator={})
    checkpoints.close()
    extra: dict[str, Any] = dict(pytorch_only)
    np.savez(run / PYTORCH_ONLY, **extra)


def read_run(run: Path) -> tuple[Config, dict[str, Any], Arrays]:
    """Read a run folder: its config, its best variables, and what `pytorch_only.npz` holds (nothing, if training made it).

    Raises:
        ValueError: not a run folder.
    """
    config = read_config(run)
    like = abstract_state(build(config), optimizer(config.optim, 1), config, device_mesh(1, 1))
    state = load_state(run, like)
    extra: Arrays = {}
    if (run / PYTORCH_ONLY).exists():
        with np.load(run / PYTORCH_ONLY, allow_pickle=False) as file:
            extra = {name: file[name] for name in file.files}
    return config, jax.tree.map(np.asarray, state.variables), extra


def _unwrap(content: Any) -> dict[Any, Any]:
    for wrapper in WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    if not isinstance(content, Mapping):
        return {"the whole file": None}
    state = dict(content)
    while state and all(str(name).startswith("module.") for name in state):
        state = {str(name).removeprefix("module."): value for name, value in state.items()}
    return state


def _array(tensor: torch.Tensor) -> NDArray:
    tensor = tensor.detach().cpu()
    return (tensor.float() if tensor.dtype == torch.bfloat16 else tensor).numpy()
