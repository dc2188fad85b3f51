"""`cmig register SOURCE TARGET [--transform FILE] [--aligned FILE] [--picture FILE.png] [--view FILE.html]`, and its other two forms.

`--pairs LIST.csv --out DIR` (`register_pairs`) and `--sequence SCAN SCAN ... --out DIR` (`register_sequence`).
"""

from __future__ import annotations

import io
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from cmig_jax.commands.parsing import parser_of
from cmig_jax.commands.register_inputs import Options, load_network, points_of, warn_of_units

if TYPE_CHECKING:
    from cmig_jax.data.geometry_files import GeometryFile
    from cmig_jax.registration.result import Registration

MOST_DRAWN = 2_000
OUTPUTS = {"transform": (".txt", ".json", ".npy"), "picture": (".png", ".pdf", ".svg"), "view": (".html",)}


@dataclass(frozen=True)
class Command:
    """Find the rigid transform that takes a source onto a target; print it and whether it can be trusted, and write files.

    With --pairs, of many pairs; with --sequence, the poses of several scans. The exit code is 0 if all transforms are trusted, 1 if one is
    not (files are written all the same), 2 for bad input.
    """

    source: Positional[Annotated[Path | None, arg(metavar="SOURCE")]] = None
    """Cloud (PLY, PCD, XYZ, TXT, CSV, ASC, PTS, LAS, LAZ, NPY, NPZ, BIN) or mesh (PLY, OFF, OBJ, STL, GLB, 3MF), also with .gz, in any
    unit. Of a mesh, points on its surface are registered."""
    target: Positional[Annotated[Path | None, arg(metavar="TARGET")]] = None
    """The other one, in the same unit."""
    more: Positional[Annotated[tuple[Path, ...], arg(metavar="SCAN ...")]] = ()
    """Further scans, with --sequence."""
    pairs: Path | None = None
    """Instead of SOURCE and TARGET: CSV file with the columns source and target (relative to its folder), a row per pair, and if wanted
    name and rotations. Writes results.csv to --out; the same command continues an interrupted run."""
    sequence: bool = False
    """SOURCE TARGET SCAN ... are scans of one scene: find the poses of all in the frame of the first. Writes merged.ply, poses.json and a
    4 x 4 matrix per scan to --out."""
    out: Path | None = None
    """Folder for what --pairs or --sequence writes."""
    network: Path | None = None
    """Run folder or weights file of a network whose pose is one more start of the search."""
    rotations: Literal["any", "yaw"] | float = "any"
    """Largest angle of the rotation in degrees, or yaw for turns about --up alone, if that is known."""
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
    view: Path | None = None
    """Page (HTML) to turn both clouds in, before and after, with the verdict, correspondences, distances and alternatives."""
    up: Literal["x", "y", "z"] = "z"
    """Axis that points upward: the one that --rotations yaw turns about, in the picture, and at first in the view."""
    json: bool = False
    """Print the result as JSON and nothing else."""
    quiet: bool = False
    """Print nothing."""


parse = parser_of(Command)


def run(command: Command) -> int:
    """Register two files, a list of pairs or a sequence; return 1 if not all is trusted.

    Raises:
        ValueError: options that do not belong together, a file that cannot be read or has no format to write, or clouds that `register`
            refuses; the message names it.
    """
    files = [path for path in (command.source, command.target, *command.more) if path is not None]
    if command.pairs is None and not command.sequence:
        if len(files) != 2 or command.out is not None:
            given = f"{len(files)} files{'' if command.out is None else ' and --out'}"
            raise ValueError(f"{given}; expected SOURCE TARGET, or --pairs LIST.csv --out DIR, or --sequence SCAN SCAN ... --out DIR")
        return _register_two(command, *files)
    for name in ("transform", "aligned", "picture", "view", "json"):
        if vars(command)[name]:
            raise ValueError(f"--{name}: expected with SOURCE TARGET alone; --pairs and --sequence write to --out")
    if command.out is None:
        raise ValueError(f"no --out; expected a folder for what {'--sequence' if command.sequence else '--pairs'} writes")
    if command.pairs is not None and (files or command.sequence):
        raise ValueError(f"--pairs {command.pairs} with {len(files)} files or --sequence; expected neither beside it")
    if command.sequence and (len(files) < 2 or not command.refine):
        raise ValueError(f"--sequence with {len(files)} files{'' if command.refine else ' and --no-refine'}; expected two or more scans")
    invalid = "drop" if command.drop_invalid else "error"
    options = Options(*load_network(command.network), command.rotations, command.up, command.refine, invalid)
    if command.pairs is not None:
        from cmig_jax.commands.register_pairs import run_pairs

        return run_pairs(command.pairs, command.out, options, command.quiet)
    from cmig_jax.commands.register_sequence import run_sequence

    return run_sequence(files, command.out, options, command.quiet)


def _register_two(command: Command, source_file: Path, target_file: Path) -> int:
    from cmig_jax.data.geometry_files import SUFFIXES, read_geometry, suffix_of
    from cmig_jax.registration.register import register

    outputs = {"transform": command.transform, "aligned": command.aligned, "picture": command.picture, "view": command.view}
    for name, path in outputs.items():
        suffixes = SUFFIXES if name == "aligned" else OUTPUTS[name]
        suffix = None if path is None else suffix_of(path) if name == "aligned" else path.suffix.lower()
        if path is not None and (suffix not in suffixes or not path.parent.is_dir()):
            raise ValueError(f"--{name} {path}: expected a file of {', '.join(suffixes)} in an existing folder")
        if path is not None and (path.is_dir() or not os.access(path.parent, os.W_OK)):
            raise ValueError(f"--{name} {path}: {'a folder' if path.is_dir() else 'no permission to write'}; expected a file to write")
    files = [read_geometry(path, "drop" if command.drop_invalid else "error") for path in (source_file, target_file)]
    source, target = (points_of(file.geometry, seed) for seed, file in enumerate(files))
    say = (lambda text: None) if command.quiet or command.json else print
    for file in files:
        if file.dropped:
            say(f"{file.path}: {file.dropped} points left out that are not finite")
        if file.unit:
            say(f"{file.path}: coordinates in {file.unit}, taken as they are")
    warn_of_units(*files)
    say(f"{source_file}: {len(source)} points; {target_file}: {len(target)} points")
    if command.network is not None:
        from cmig_jax.compilation import keep_compiled_programs

        keep_compiled_programs()
    found = register(source, target, command.network, rotations=command.rotations, up=command.up, refine=command.refine)
    say(str(found))
    if command.json:
        print(_as_json(found))
    _write(command, files[0], found)
    if command.picture is not None:
        from cmig_jax.report.plots import plot_pairs

        shown = [cloud[:: 1 + len(cloud) // MOST_DRAWN] for cloud in (source, target)]
        pose = found.target_from_source
        pair = {"source": shown[0], "target": shown[1], "R": pose.R, "t": pose.t, "title": source_file.name}
        plot_pairs([pair], command.picture, up=command.up)
    if command.view is not None:
        from cmig_jax.report.registration_page import write_registration_page

        write_registration_page(command.view, source, target, found, (source_file.name, target_file.name), up=command.up)
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
