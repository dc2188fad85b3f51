"""Trained networks in one file: what `load` reads when it is not given a run folder, and the network that comes with the package.

A weights file is a NumPy archive of the network's variables in half precision, and its config as JSON.
`python -m cmig_jax.export RUN_FOLDER FILE.npz` writes one.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from cmig_jax.config import Config, from_json, to_json

PRETRAINED = Path(__file__).with_name("pretrained") / "own-clouds.npz"
"""The network of `train.py own-clouds`, on generated objects alone."""
CONFIG, STEP = "config.json", "step"


def write_weights(path: Path, config: Config, step: int, variables: Mapping[str, Any]) -> None:
    """Write a weights file, under a temporary name first.

    Args:
        path: the file, ending in `.npz`.
        config: the flags of the network.
        step: training steps behind it.
        variables: `params` and `batch_stats`.
    """
    flat: dict[str, Any] = traverse_util.flatten_dict(dict(variables), sep="/")  # pyright: ignore[reportAssignmentType]
    arrays = {name: np.asarray(value, np.float16 if name.startswith("params/") else np.float32) for name, value in flat.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.partial")
    with temporary.open("wb") as file:
        np.savez_compressed(file, **{CONFIG: np.array(to_json(config)), STEP: np.array(step)}, **arrays)  # pyright: ignore[reportArgumentType]
    temporary.replace(path)


def read_weights(path: Path) -> tuple[Config, int, dict[str, Any]]:
    """Read a weights file: the config, the training steps, and the variables in float32.

    Raises:
        ValueError: not such a file, or damaged; the message names it.
    """
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            config = from_json(str(archive[CONFIG]))
            flat = {name: jnp.asarray(archive[name], jnp.float32) for name in archive.files if "/" in name}
            step = int(archive[STEP])
    except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: expected a weights file of cmig_jax ({error})") from error
    return config, step, traverse_util.unflatten_dict(flat, sep="/")


def check_variables(variables: Mapping[str, Any], like: Mapping[str, Any], where: str) -> None:
    """Refuse variables that are not those of a network.

    Raises:
        ValueError: naming the missing, surplus and mis-shaped arrays.
    """
    found, wanted = _shapes(variables), _shapes(like)
    faults = [f"missing {name}" for name in wanted if name not in found] + [f"surplus {name}" for name in found if name not in wanted]
    faults += [f"{name} {found[name]} instead of {wanted[name]}" for name in wanted if name in found and found[name] != wanted[name]]
    if faults:
        raise ValueError(f"{where}: not of the network in its config: {', '.join(faults)}")


def _shapes(tree: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    flat: dict[str, Any] = traverse_util.flatten_dict(dict(tree), sep="/")  # pyright: ignore[reportAssignmentType]
    return {name: value.shape for name, value in flat.items()}
