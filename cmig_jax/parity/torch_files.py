"""PyTorch weight files of any network: `.t7`, `.pt`, `.pth`, `.safetensors`."""

from __future__ import annotations

import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch

from cmig_jax.files import replacing
from cmig_jax.parity.cases import Arrays, State

SUFFIXES = (".t7", ".pt", ".pth", ".safetensors")
WRAPPERS = ("state_dict", "model_state_dict", "model")


def is_torch_file(path: Path) -> bool:
    """Return whether a path has the suffix of a PyTorch file, and is not a folder."""
    return path.suffix in SUFFIXES and not path.is_dir()


def read_torch(path: Path) -> Arrays:
    """Read a `state_dict`, without `module.` prefixes and the `{"state_dict": ...}` around it.

    Only tensors are read: a pickle that would run code is refused.

    Raises:
        ValueError: no such file, not readable as weights, or something else than tensors in it.
    """
    if not is_torch_file(path):
        raise ValueError(f"{path}: expected a PyTorch file ({', '.join(SUFFIXES)})")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about the pickle's protocol, on files that are refused anyway
            is_safe = path.suffix == ".safetensors"
            content: Any = safetensors.torch.load_file(path) if is_safe else torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise ValueError(f"{path}: refused, since it holds more than tensors or is no PyTorch file ({_first_line(error)})") from error
    except (OSError, EOFError, RuntimeError, KeyError, zipfile.BadZipFile, safetensors.SafetensorError) as error:
        raise ValueError(f"{path}: expected PyTorch weights ({_first_line(error)})") from error
    for wrapper in WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(wrapper), Mapping):
            content = content[wrapper]
    state = dict(content) if isinstance(content, Mapping) else {}
    if not state or not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise ValueError(f"{path}: expected a dict of tensors, found {type(content).__name__} {[*state]}")
    while all(str(name).startswith("module.") for name in state):
        state = {str(name).removeprefix("module."): value for name, value in state.items()}
    tensors = {str(name): value.detach().cpu() for name, value in state.items()}
    return {name: (x.float() if x.dtype == torch.bfloat16 else x).numpy() for name, x in tensors.items()}  # NumPy has no bfloat16


def write_torch(path: Path, state: State) -> None:
    """Write a `state_dict`."""
    tensors = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}
    with replacing(path) as file:
        if path.suffix == ".safetensors":
            file.write(safetensors.torch.save(tensors))
        else:
            torch.save(tensors, file)


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
