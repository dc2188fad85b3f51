"""The Stanford 3D Scanning Repository (Sec. IV-D): finished models, and raw range scans with the poses that join them.

A `.conf` file lists the scans: `bmesh FILE tx ty tz qx qy qz qw` means x_world = R(q)^T x_scan + t, in metres.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from cmig_jax.data.geometry_files import read_geometry
from cmig_jax.data.raw import RawDataset, RawObject, existing_folder

# Fused scans keep one point per cell of this share of their extent: otherwise regions seen by many scans would weigh more.
_CELL = 1 / 400


@dataclass(frozen=True)
class Scan:
    """A range scan.

    Attributes:
        name: its file, without suffix.
        points: `[P, 3]` float32, in the scanner's frame, metres.
        world_from_scan: `[4, 4]` float64.
    """

    name: str
    points: np.ndarray
    world_from_scan: np.ndarray


def read_scans(conf_path: str | Path) -> list[Scan]:
    """Read the range scans that a `.conf` file lists, with their poses.

    Raises:
        ValueError: a missing file, a malformed line, a zero quaternion, or no scans.
    """
    conf = Path(conf_path)
    if not conf.is_file():
        raise ValueError(f"{conf}: no such file; expected the .conf of some range scans")
    lines = [(number, line.split()) for number, line in enumerate(conf.read_text().splitlines(), 1)]
    scans = [_scan(conf, number, words) for number, words in lines if words and words[0] in ("bmesh", "mesh")]
    if not scans:
        raise ValueError(f"{conf}: no scans; expected lines `bmesh FILE tx ty tz qx qy qz qw`")
    return scans


def open_stanford(root: str | None) -> RawDataset:
    """Open every PLY model below a folder as a test object of the one category "scan"; the train split is empty: evaluation only.

    The scans of a folder with a `.conf` file are fused, in the world frame, into one object that is named after the folder.

    Raises:
        ValueError: no such folder, or no PLY files in it.
    """
    folder = existing_folder(root, "a folder of PLY models, or of range scans with their .conf")
    confs = {path.parent: path for path in sorted(folder.rglob("*.conf"))}
    objects = []
    for place, conf in confs.items():
        name = folder.resolve().name if place == folder else str(place.relative_to(folder))
        objects.append(RawObject(name, 0, "test", functools.partial(_fused, conf)))
    models = [path for path in sorted(folder.rglob("*.ply")) if path.parent not in confs and not path.name.startswith(".")]
    objects += [RawObject(str(path.relative_to(folder)), 0, "test", functools.partial(read_geometry, path)) for path in models]
    if not objects:
        raise ValueError(f"{folder}: no *.ply and no *.conf in it; expected PLY models, or range scans with their .conf")
    return RawDataset(("scan",), tuple(objects), "stanford")


def _scan(conf: Path, number: int, words: list[str]) -> Scan:
    try:
        x, y, z, *quaternion = (float(word) for word in words[2:])
        if len(quaternion) != 4:
            raise ValueError(f"{len(words) - 2} numbers")
        world_from_scan = np.eye(4)
        world_from_scan[:3, :3] = Rotation.from_quat(quaternion).as_matrix().T
        world_from_scan[:3, 3] = x, y, z
    except ValueError as error:
        raise ValueError(f"{conf}, line {number}: {' '.join(words)!r} ({error}); expected bmesh FILE tx ty tz qx qy qz qw") from error
    path = conf.parent / words[1]
    if not path.is_file():
        raise ValueError(f"{path}: no such file; {conf}, line {number}, lists it")
    geometry = read_geometry(path)
    points = np.asarray(geometry.vertices, np.float32) if isinstance(geometry, trimesh.Trimesh) else geometry
    return Scan(path.stem, points, world_from_scan)


def _fused(conf: Path) -> np.ndarray:
    clouds = [scan.points @ scan.world_from_scan[:3, :3].T + scan.world_from_scan[:3, 3] for scan in read_scans(conf)]
    points = np.concatenate(clouds)
    cell = np.ptp(points, axis=0).max() * _CELL
    if not cell > 0:
        return points
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)].astype(np.float32)
