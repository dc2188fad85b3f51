"""Register two files: `python -m cmig_jax.align SOURCE TARGET [--transform FILE.txt] [--aligned FILE.ply] [--picture FILE.png]`."""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import trimesh
import tyro
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from trimesh.exchange.ply import export_ply

from cmig_jax.compilation import keep_compiled_programs
from cmig_jax.data.geometry_files import read_geometry
from cmig_jax.data.sample import sample_surface
from cmig_jax.data.shards import replacing
from cmig_jax.registration import load, register
from cmig_jax.report.plots import plot_pairs

ON_A_MESH = 10_000
DRAWN = 2_000
WRITTEN = {"transform": (".txt",), "aligned": (".ply", ".npy"), "picture": (".png", ".pdf", ".svg")}


@dataclass(frozen=True)
class Command:
    """Find the rigid transform that takes a source onto a target, print it, and write what is asked for."""

    source: Annotated[Path, tyro.conf.Positional]
    """Cloud or mesh (PLY, NPY `[N, 3]`, OFF, OBJ, STL), in any unit. Of a mesh, points on its surface are registered."""
    target: Annotated[Path, tyro.conf.Positional]
    """The other one, in the same unit."""
    network: Path | None = None
    """Run folder or weights file; by default the network that comes with the package."""
    points: int | None = None
    """Points per cloud that the network reads at most; by default as many as it was trained on."""
    refine: bool = True
    """Finish with (generalised) ICP on the whole clouds."""
    transform: Path | None = None
    """Text file for target_from_source, a 4 x 4 matrix."""
    aligned: Path | None = None
    """File for the source in the target's frame: PLY (single precision), or NPY of its points."""
    picture: Path | None = None
    """Picture of both before and after: PNG, PDF or SVG."""
    up: Literal["x", "y", "z"] = "z"
    """Axis that points upward in the picture."""


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, register, and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    command = tyro.cli(Command, prog="python -m cmig_jax.align", args=arguments)
    try:
        align(command)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130
    return 0


def align(command: Command) -> None:
    """Register the two files of a command, print the transform and what it brings, and write its files.

    Raises:
        ValueError: a file that cannot be read or is no format to write, or clouds that `register` refuses; the message names it.
    """
    for name, suffixes in WRITTEN.items():
        path: Path | None = getattr(command, name)
        if path is not None and (path.suffix.lower() not in suffixes or not path.parent.is_dir()):
            raise ValueError(f"--{name} {path}: expected a file of {', '.join(suffixes)} in a folder that is there")
    geometry = read_geometry(command.source)
    source, target = _points(geometry), _points(read_geometry(command.target))
    network = None if command.network is None else load(command.network)
    print(f"{command.source}: {len(source)} points; {command.target}: {len(target)} points", flush=True)
    found = register(source, target, network, points=command.points, refine=command.refine)
    moved = source @ found.R.T + found.t
    target_from_source = np.vstack([np.column_stack([found.R, found.t]), [0, 0, 0, 1]])
    matrix, tree = _as_text(target_from_source), KDTree(target)
    before, after = (np.median(tree.query(cloud)[0]) for cloud in (source, moved))
    print(f"target_from_source:\n{matrix}")
    print(f"a rotation by {np.degrees(Rotation.from_matrix(found.R).magnitude()):.2f} degrees")
    print(f"from a source point to the nearest target point, median: {before:.4g} before, {after:.4g} after")
    if command.transform is not None:
        with replacing(command.transform) as file:
            file.write(f"{matrix}\n".encode())
    if command.aligned is not None:
        with replacing(command.aligned) as file:
            file.write(_in_format(command.aligned, geometry, target_from_source))
    if command.picture is not None:
        shown = [cloud[:: 1 + len(cloud) // DRAWN] for cloud in (source, target)]
        pair = {"source": shown[0], "target": shown[1], "R": found.R, "t": found.t, "title": command.source.name}
        plot_pairs([pair], command.picture, up=command.up)


def _points(geometry: trimesh.Trimesh | np.ndarray) -> np.ndarray:
    return geometry if isinstance(geometry, np.ndarray) else sample_surface(geometry, ON_A_MESH, np.random.default_rng(0))


def _as_text(matrix: np.ndarray) -> str:
    written = io.StringIO()
    np.savetxt(written, matrix, fmt="%20.12g")
    return written.getvalue().rstrip("\n")


def _in_format(path: Path, geometry: trimesh.Trimesh | np.ndarray, target_from_source: np.ndarray) -> bytes:
    """Write a moved geometry as the file's suffix says."""
    moved = trimesh.PointCloud(geometry) if isinstance(geometry, np.ndarray) else geometry.copy()
    moved.apply_transform(target_from_source)
    if path.suffix.lower() == ".ply":
        return export_ply(moved)
    written = io.BytesIO()
    np.save(written, np.asarray(moved.vertices))
    return written.getvalue()


if __name__ == "__main__":
    keep_compiled_programs()
    raise SystemExit(main())
