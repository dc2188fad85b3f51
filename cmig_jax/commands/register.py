"""`cmig register SOURCE TARGET [--transform FILE] [--aligned FILE] [--picture FILE.png]`."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import trimesh
from tyro.conf import Positional

from cmig_jax.commands.parsing import parser_of

if TYPE_CHECKING:
    from cmig_jax.data.geometry_files import GeometryFile
    from cmig_jax.registration.result import Registration

POINTS_ON_A_MESH = 10_000
MOST_DRAWN = 2_000
OUTPUTS = {"transform": (".txt", ".json", ".npy"), "picture": (".png", ".pdf", ".svg")}


@dataclass(frozen=True)
class Command:
    """Find the rigid transform that takes a source onto a target; print it and whether it can be trusted, and write files.

    The exit code is 0 if the transform is trusted, 1 if it is not (files are written all the same), 2 for bad input.
    """

    source: Positional[Path]
    """Cloud (PLY, PCD, XYZ, TXT, CSV, ASC, PTS, LAS, LAZ, NPY, NPZ, BIN) or mesh (PLY, OFF, OBJ, STL, GLB, 3MF), also with .gz, in any
    unit. Of a mesh, points on its surface are registered."""
    target: Positional[Path]
    """The other one, in the same unit."""
    network: Path | None = None
    """Run folder or weights file of a network whose pose is one more start of the search."""
    rotations: float | None = None
    """Largest angle of the rotation in degrees, if it is known."""
    refine: bool = True
    """Without it, the result is the network's pose as it is."""
    transform: Path | None = None
    """File for target_from_source, a 4 x 4 matrix (TXT, NPY), or with the verdict (JSON)."""
    aligned: Path | None = None
    """File for the source in the target's frame, in any of these formats; in the source's own it keeps colours and other attributes."""
    drop_invalid: bool = False
    """Leave out points whose coordinates are not finite; otherwise they are an error."""
    picture: Path | None = None
    """Picture of both before and after: PNG, PDF or SVG."""
    up: Literal["x", "y", "z"] = "z"
    """Axis that points upward in the picture."""
    json: bool = False
    """Print the result as JSON and nothing else."""
    quiet: bool = False
    """Print nothing."""


parse = parser_of(Command)


def run(command: Command) -> int:
    """Register, print the result, and write the files; return 1 if it is not trusted.

    Raises:
        ValueError: a file that cannot be read or has no format to write, or clouds that `register` refuses; the message names it.
    """
    from cmig_jax.data.geometry_files import SUFFIXES, read_geometry, suffix_of
    from cmig_jax.registration.register import register

    for name, path in (("transform", command.transform), ("aligned", command.aligned), ("picture", command.picture)):
        suffixes = SUFFIXES if name == "aligned" else OUTPUTS[name]
        suffix = None if path is None else suffix_of(path) if name == "aligned" else path.suffix.lower()
        if path is not None and (suffix not in suffixes or not path.parent.is_dir()):
            raise ValueError(f"--{name} {path}: expected a file of {', '.join(suffixes)} in an existing folder")
    files = [read_geometry(path, "drop" if command.drop_invalid else "error") for path in (command.source, command.target)]
    source, target = (_points(file.geometry, seed) for seed, file in enumerate(files))
    say = (lambda text: None) if command.quiet or command.json else print
    for file in files:
        if file.dropped:
            say(f"{file.path}: {file.dropped} points left out that are not finite")
    say(f"{command.source}: {len(source)} points; {command.target}: {len(target)} points")
    if command.network is not None:
        from cmig_jax.compilation import keep_compiled_programs

        keep_compiled_programs()
    limit = "any" if command.rotations is None else command.rotations
    found = register(source, target, command.network, rotations=limit, refine=command.refine)
    say(str(found))
    if command.json:
        print(_as_json(found))
    _write(command, files[0], found)
    if command.picture is not None:
        from cmig_jax.report.plots import plot_pairs

        shown = [cloud[:: 1 + len(cloud) // MOST_DRAWN] for cloud in (source, target)]
        pose = found.target_from_source
        pair = {"source": shown[0], "target": shown[1], "R": pose.R, "t": pose.t, "title": command.source.name}
        plot_pairs([pair], command.picture, up=command.up)
    return int(not found.trusted)


def _write(command: Command, source: GeometryFile, found: Registration) -> None:
    from cmig_jax.data.geometry_files import write_moved
    from cmig_jax.files import replacing

    if command.transform is not None:
        with replacing(command.transform) as file:
            file.write(_transform_file(command.transform.suffix.lower(), found))
    if command.aligned is not None:
        write_moved(command.aligned, source, found.matrix)


def _transform_file(suffix: str, found: Registration) -> bytes:
    if suffix == ".json":
        return f"{_as_json(found)}\n".encode()
    written = io.BytesIO()
    if suffix == ".npy":
        np.save(written, found.matrix)
    else:
        np.savetxt(written, found.matrix, fmt="%20.12g")
    return written.getvalue()


def _as_json(found: Registration) -> str:
    values = {
        "target_from_source": found.matrix.tolist(),
        "trusted": found.trusted,
        "why": found.why,
        "confidence": found.confidence,
        "overlap": found.overlap,
        "inlier_rmse": found.inlier_rmse,
        "alternatives": [pose.as_matrix().tolist() for pose in found.alternatives],
        "seconds": found.seconds,
    }
    return json.dumps(values, indent=1)


def _points(geometry: trimesh.Trimesh | np.ndarray, seed: int) -> np.ndarray:
    """Return a cloud, or points on a mesh; two meshes need two seeds, or a mesh and its moved copy would share points."""
    from cmig_jax.data.sample import sample_surface

    if isinstance(geometry, np.ndarray):
        return geometry
    return sample_surface(geometry, POINTS_ON_A_MESH, np.random.default_rng(seed))
