"""`cmig register --sequence SCAN SCAN ... --out DIR`: all scans into the frame of the first, and one merged cloud."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cmig_jax.commands.register_inputs import Options, points_of, warn_of_units

if TYPE_CHECKING:
    from cmig_jax.data.geometry_files import GeometryFile
    from cmig_jax.registration.scan_sequence import ScanSequence

COLOURS, NORMALS = ("red", "green", "blue"), ("nx", "ny", "nz")


def run_sequence(paths: Sequence[Path], out: Path, options: Options, quiet: bool) -> int:
    """Register the scans; write `merged.ply`, `poses.json` and a matrix per scan; return 1 if a scan has no pose, otherwise 0.

    Raises:
        ValueError: a file that cannot be read, or a cloud that `register` refuses; the message names it.
    """
    from cmig_jax.data.geometry_files import read_geometry
    from cmig_jax.files import replacing, write_text
    from cmig_jax.registration.sequence import register_sequence

    out.mkdir(parents=True, exist_ok=True)
    files = [read_geometry(path, options.invalid) for path in paths]
    for file in files[1:]:
        warn_of_units(files[0], file)
    clouds = [points_of(file.geometry, seed) for seed, file in enumerate(files)]
    names = [str(path) for path in paths]
    found = register_sequence(clouds, options.network, rotations=options.rotations, up=options.up, names=names, progress=not quiet)
    write_text(out / "poses.json", json.dumps(_as_values(found), indent=1) + "\n")
    (out / "poses").mkdir(exist_ok=True)
    for old in (out / "poses").glob("*.txt"):
        old.unlink()
    for i, (path, scan) in enumerate(zip(paths, found.scans, strict=True)):
        if scan.pose is not None:
            rows = "\n".join(" ".join(f"{number:20.12g}" for number in row) for row in scan.pose.as_matrix())
            write_text(out / "poses" / f"{i:03d}_{path.stem}.txt", rows + "\n")
    with replacing(out / "merged.ply") as written:
        written.write(_merged(files, clouds, found))
    if not quiet:
        for file in files:
            if file.dropped:
                print(f"{file.path}: {file.dropped} points left out that are not finite")
        print(f"{found}\n{out / 'merged.ply'}, {out / 'poses.json'}")
    return int(not found.trusted)


def _as_values(found: ScanSequence) -> dict[str, Any]:
    scans = found.scans
    return {
        "frame": scans[0].name,
        "trusted": found.trusted,
        "scans": [
            {
                "name": scan.name,
                "first_from_scan": None if scan.pose is None else scan.pose.as_matrix().tolist(),
                "group": scans[scan.group].name,
                "confidence": scan.confidence,
                "why": scan.why,
            }
            for scan in scans
        ],
        "registrations": [
            {
                "source": [scans[i].name for i in pair.source],
                "target": [scans[i].name for i in pair.target],
                "target_from_source": pair.target_from_source.as_matrix().tolist(),
                "trusted": pair.trusted,
                "confidence": pair.confidence,
                "overlap": pair.overlap,
                "inlier_rmse": pair.inlier_rmse,
                "used": pair.used,
                "why": pair.why,
            }
            for pair in found.pairs
        ],
    }


def _merged(files: Sequence[GeometryFile], clouds: Sequence[np.ndarray], found: ScanSequence) -> bytes:
    """Encode the scans that have a pose as one PLY cloud, with the colours and normals that all of these have as PLY files."""
    from cmig_jax.data.formats.content import coordinate_type
    from cmig_jax.data.formats.ply import Ply
    from cmig_jax.data.formats.ply_elements import Element, Property
    from cmig_jax.registration.scan_sequence import merge

    placed = [(cloud, _vertices(file), scan.pose) for cloud, file, scan in zip(clouds, files, found.scans, strict=True) if scan.pose]
    kinds = [names for names in (COLOURS, NORMALS) if all(set(names) <= set(columns) for _, columns, _ in placed)]
    tables = []
    for cloud, columns, pose in placed:
        values = [np.nan_to_num(np.stack([columns[name] for name in names], axis=1).astype(np.float64)) for names in kinds]
        turned = [value @ pose.R.T if names == NORMALS else value for names, value in zip(kinds, values, strict=True)]
        tables.append(np.concatenate([pose.apply(cloud), *turned], axis=1))
    table = merge(tables)
    written = {name: table[:, i].astype(coordinate_type(table[:, :3])) for i, name in enumerate("xyz")}
    for i, names in enumerate(kinds):
        values = table[:, 3 + 3 * i : 6 + 3 * i]
        if names == NORMALS:
            values = (values / np.linalg.norm(values, axis=1, keepdims=True).clip(1e-12)).astype(np.float32)
        else:
            kind = np.result_type(*(columns[name].dtype for _, columns, _ in placed for name in names))
            values = (values.round() if kind.kind in "iu" else values).astype(kind)
        written |= dict(zip(names, values.T, strict=True))
    vertex = Element("vertex", len(table), tuple(Property(name, column.dtype.str[1:]) for name, column in written.items()))
    return Ply((), ((vertex, dict(written)),)).moved(np.eye(4), ".ply")


def _vertices(file: GeometryFile) -> dict[str, np.ndarray]:
    """Return the columns of a PLY cloud by lower-case name, without points that are not finite; none of another format or a mesh."""
    from cmig_jax.data.formats.content import axes, stacked
    from cmig_jax.data.formats.ply import Ply

    if file.mesh is not None or not isinstance(file.content, Ply):
        return {}
    columns = next(columns for element, columns in file.content.elements if element.name.lower() == "vertex")
    numbers = {name: column for name, column in columns.items() if isinstance(column, np.ndarray) and column.ndim == 1}
    names = axes(list(numbers))
    finite = np.isfinite(stacked(numbers, names)).all(axis=1) if names else slice(None)
    return {name.lower(): column[finite] for name, column in numbers.items()}
