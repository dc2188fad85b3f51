"""`cmig register SOURCE TARGET [--transform FILE.txt] [--aligned FILE.ply] [--picture FILE.png]`."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh
from tyro.conf import Positional

from cmig_jax.commands.parsing import parser_of

POINTS_ON_A_MESH = 10_000
MOST_DRAWN = 2_000
OUTPUTS = {"transform": (".txt",), "aligned": (".ply", ".npy"), "picture": (".png", ".pdf", ".svg")}


@dataclass(frozen=True)
class Command:
    """Find the rigid transform that takes a source onto a target; print it, and write the files that are asked for."""

    source: Positional[Path]
    """Cloud or mesh (PLY, NPY `[N, 3]`, OFF, OBJ, STL), in any unit. Of a mesh, points on its surface are registered."""
    target: Positional[Path]
    """The other one, in the same unit."""
    network: Path | None = None
    """Run folder or weights file; by default the network that comes with the package."""
    points: int | None = None
    """Points per cloud that the network reads at most; by default as many as it was trained on."""
    refine: bool = True
    """Refine the pose by (generalised) ICP on the whole clouds."""
    transform: Path | None = None
    """Text file for target_from_source, a 4 x 4 matrix."""
    aligned: Path | None = None
    """File for the source in the target's frame: PLY (single precision), or NPY of its points."""
    picture: Path | None = None
    """Picture of both before and after: PNG, PDF or SVG."""
    up: Literal["x", "y", "z"] = "z"
    """Axis that points upward in the picture."""


parse = parser_of(Command)


def run(command: Command) -> int:
    """Register, print the transform and the distances before and after, and write the files.

    Raises:
        ValueError: a file that cannot be read or has no format to write, or clouds that `register` refuses; the message names it.
    """
    from scipy.spatial import KDTree

    from cmig_jax.compilation import keep_compiled_programs
    from cmig_jax.data.geometry_files import read_geometry
    from cmig_jax.inference.load import load
    from cmig_jax.registration.register import register

    for name, path in (("transform", command.transform), ("aligned", command.aligned), ("picture", command.picture)):
        if path is not None and (path.suffix.lower() not in OUTPUTS[name] or not path.parent.is_dir()):
            raise ValueError(f"--{name} {path}: expected a file of {', '.join(OUTPUTS[name])} in an existing folder")
    geometry = read_geometry(command.source)
    source, target = _points(geometry, seed=0), _points(read_geometry(command.target), seed=1)
    keep_compiled_programs()
    network = None if command.network is None else load(command.network)
    print(f"{command.source}: {len(source)} points; {command.target}: {len(target)} points", flush=True)
    found = register(source, target, network, points=command.points, refine=command.refine)
    moved, tree = found.apply(source), KDTree(target)
    before, after = (np.median(tree.query(cloud)[0]) for cloud in (source, moved))
    matrix = _as_text(found.as_matrix())
    print(f"target_from_source:\n{matrix}")
    print(f"a rotation by {np.degrees(found.angle()):.2f} degrees")
    print(f"from a source point to the nearest target point, median: {before:.4g} before, {after:.4g} after")
    _write(command, geometry, found.as_matrix(), matrix)
    if command.picture is not None:
        from cmig_jax.report.plots import plot_pairs

        shown = [cloud[:: 1 + len(cloud) // MOST_DRAWN] for cloud in (source, target)]
        pair = {"source": shown[0], "target": shown[1], "R": found.R, "t": found.t, "title": command.source.name}
        plot_pairs([pair], command.picture, up=command.up)
    return 0


def _write(command: Command, geometry: trimesh.Trimesh | np.ndarray, target_from_source: np.ndarray, matrix: str) -> None:
    from cmig_jax.files import replacing, write_text

    if command.transform is not None:
        write_text(command.transform, f"{matrix}\n")
    if command.aligned is not None:
        with replacing(command.aligned) as file:
            file.write(_in_format(command.aligned, geometry, target_from_source))


def _points(geometry: trimesh.Trimesh | np.ndarray, seed: int) -> np.ndarray:
    """Return a cloud, or points on a mesh; two meshes need two seeds, or a mesh and its moved copy would share points."""
    from cmig_jax.data.sample import sample_surface

    if isinstance(geometry, np.ndarray):
        return geometry
    return sample_surface(geometry, POINTS_ON_A_MESH, np.random.default_rng(seed))


def _as_text(matrix: np.ndarray) -> str:
    written = io.StringIO()
    np.savetxt(written, matrix, fmt="%20.12g")
    return written.getvalue().rstrip("\n")


def _in_format(path: Path, geometry: trimesh.Trimesh | np.ndarray, target_from_source: np.ndarray) -> bytes:
    """Write a moved geometry as the file's suffix says."""
    moved = trimesh.PointCloud(geometry) if isinstance(geometry, np.ndarray) else geometry.copy()
    moved.apply_transform(target_from_source)
    if path.suffix.lower() == ".ply":
        from trimesh.exchange.ply import export_ply

        return export_ply(moved)
    written = io.BytesIO()
    np.save(written, np.asarray(moved.vertices))
    return written.getvalue()
