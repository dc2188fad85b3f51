"""Weights files: a trained network in one file, a NumPy archive of its variables in half precision and its config as JSON.

`cmig export RUN_FOLDER FILE.npz` writes one; `load` reads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from cmig_jax.config import Config
from cmig_jax.config_json import to_json
from cmig_jax.files import DAMAGED, replacing, sha256
from cmig_jax.models.networks import config_from_json

PRETRAINED = Path(__file__).parents[1] / "pretrained" / "own-clouds.npz"
"""The network that comes with the package: the preset `own-clouds`, trained on generated objects alone."""
PRETRAINED_SHA256 = "90a3138ee8e439f6f64d89bd98edd36595eeace5ef8b08444fc17f53795bf58e"
SUFFIX = ".npz"
CONFIG, STEP = "config.json", "step"


def write_weights(path: Path, config: Config, step: int, variables: Mapping[str, Any]) -> None:
    """Write a weights file.

    Args:
        path: the file, ending in `.npz`.
        config: the flags of the network.
        step: training steps behind it.
        variables: `params` and `batch_stats`.

    Raises:
        ValueError: a parameter that is not finite in half precision.
    """
    flat: dict[str, Any] = traverse_util.flatten_dict(dict(variables), sep="/")  # pyright: ignore[reportAssignmentType]
    with np.errstate(over="ignore"):
        arrays = {name: np.asarray(value, np.float16 if name.startswith("params/") else np.float32) for name, value in flat.items()}
    for name, value in arrays.items():
        if not np.isfinite(value).all():
            raise ValueError(
                f"{name}: its largest value is {np.abs(flat[name]).max():g}; half precision holds {np.finfo(np.float16).max:g}"
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        np.savez_compressed(file, **{CONFIG: np.array(to_json(config)), STEP: np.array(step)}, **arrays)  # pyright: ignore[reportArgumentType]


def read_weights(path: Path) -> tuple[Config, int, dict[str, Any]]:
    """Read a weights file: the config, the training steps, and the variables in float32.

    Raises:
        ValueError: not a weights file, or damaged, or in the package's place another than it came with; the message names it.
    """
    if path == PRETRAINED and path.exists() and (found := sha256(path)) != PRETRAINED_SHA256:
        raise ValueError(f"{path}: SHA-256 {found}; expected {PRETRAINED_SHA256}, the file that comes with the package: install it again")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            config = config_from_json(str(archive[CONFIG]))
            flat = {name: jnp.asarray(archive[name], jnp.float32) for name in archive.files if "/" in name}
            step = int(archive[STEP])
    except DAMAGED as error:
        raise ValueError(f"{path}: expected a weights file of cmig_jax ({error})") from error
    return config, step, traverse_util.unflatten_dict(flat, sep="/")


def check_variables(variables: Mapping[str, Any], like: Mapping[str, Any], where: str) -> None:
    """Refuse variables of another network.

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
