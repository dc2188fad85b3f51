"""What the three forms of `cmig register` share: how files become points, and the options of a registration."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import trimesh

if TYPE_CHECKING:
    from cmig_jax.data.geometry_files import GeometryFile

POINTS_ON_A_MESH = 10_000


@dataclass(frozen=True)
class Options:
    """Options of every registration of a command.

    Attributes:
        network: None, or what `load` returns.
        network_key: its path and step, which tell it from others.
        rotations, up, refine, invalid: as of `register`.
    """

    network: Any
    network_key: str
    rotations: Literal["any", "yaw"] | float
    up: Literal["x", "y", "z"]
    refine: bool
    invalid: Literal["error", "drop"]


def load_network(path: Path | None) -> tuple[Any, str]:
    """Load the network of `--network` once, and keep its compiled programs for later commands; return it and its key."""
    if path is None:
        return None, ""
    from cmig_jax.compilation import keep_compiled_programs
    from cmig_jax.inference.load import load

    keep_compiled_programs()
    network = load(path)
    return network, f"{path.resolve()}, step {network.step}"


def points_of(geometry: trimesh.Trimesh | np.ndarray, seed: int) -> np.ndarray:
    """Return a cloud, or points on a mesh; two meshes need two seeds, or a mesh and its moved copy would share points."""
    from cmig_jax.data.sample import sample_surface

    if isinstance(geometry, np.ndarray):
        return geometry
    return sample_surface(geometry, POINTS_ON_A_MESH, np.random.default_rng(seed))


def warn_of_units(source: GeometryFile, target: GeometryFile) -> None:
    """Warn if both files say a unit (3MF, GLB), and not the same one; coordinates are taken as they are."""
    if source.unit and target.unit and abs(trimesh.units.unit_conversion(source.unit, target.unit) - 1) > 1e-6:
        named = f"{source.path} is in {source.unit}, {target.path} in {target.unit}"
        print(f"warning: {named}; expected the same unit", file=sys.stderr)
