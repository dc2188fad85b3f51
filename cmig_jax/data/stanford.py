"""The Stanford 3D Scanning Repository (Sec. IV-D): finished models, and raw range scans with the poses that join them.

Download: the reconstructed models (`bun_zipper.ply`, `dragon_vrip.ply`, ...) and the raw range data of a model (`bunny/data/` with
`bun.conf`). A `.conf` file lists the scans: `bmesh FILE tx ty tz qx qy qz qw` means x_world = R(q)^T x_scan + t, in metres.
`docs/data.md` says where they go.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from cmig_jax.data.geometry_files import read_geometry
from cmig_jax.data.raw import RawDataset, RawObject, RecordedDataset, Recording, existing_folder

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
    listed = _listed(Path(conf_path))
    return [Scan(path.stem, _read_scan(path), world_from_scan) for path, world_from_scan in listed]


def open_stanford(root: str | None) -> RawDataset:
    """Open every PLY model below a folder as a test object of the one category "scan"; the train split is empty: evaluation only.

    The scans of a folder with a `.conf` file are fused, in the world frame, into one object that is named after the folder; of a
    folder with several `.conf` files each makes one, named after folder and file.

    Raises:
        ValueError: no such folder, or no PLY files in it.
    """
    folder = existing_folder(root, "a folder of PLY models, or of range scans with their .conf")
    confs = {place: list(found) for place, found in itertools.groupby(sorted(folder.rglob("*.conf")), lambda path: path.parent)}
    objects = []
    for place, found in confs.items():
        name = folder.resolve().name if place == folder else str(place.relative_to(folder))
        for conf in found:
            objects.append(RawObject(name if len(found) == 1 else f"{name}/{conf.stem}", 0, "test", functools.partial(_fused, conf)))
    models = [path for path in sorted(folder.rglob("*.ply")) if path.parent not in confs and not path.name.startswith(".")]
    objects += [RawObject(str(path.relative_to(folder)), 0, "test", functools.partial(read_geometry, path)) for path in models]
    if not objects:
        raise ValueError(f"{folder}: no *.ply and no *.conf in it; expected PLY models, or range scans with their .conf")
    return RawDataset(("scan",), tuple(objects), "stanford")


def open_scans(root: str | None) -> RecordedDataset:
    """Open the range scans of every `.conf` below a folder: a scene each, any two of its scans a candidate.

    Raises:
        ValueError: no such folder, no `.conf` in it, or one that `read_scans` refuses.
    """
    folder = existing_folder(root, "a folder of range scans with their .conf")
    confs = sorted(folder.rglob("*.conf"))
    if not confs:
        raise ValueError(f"{folder}: no *.conf in it; expected range scans with their .conf")
    categories = tuple(str(conf.relative_to(folder).with_suffix("")) for conf in confs)
    recordings, candidates = [], []
    for label, conf in enumerate(confs):
        first = len(recordings)
        for path, world_from_scan in _listed(conf):
            name = f"{categories[label]}/{path.stem}"
            recordings.append(Recording(name, label, functools.partial(_read_scan, path), world_from_scan))
        candidates += itertools.combinations(range(first, len(recordings)), 2)
    return RecordedDataset(categories, tuple(recordings), tuple(candidates), "stanford-scans")


def _listed(conf: Path) -> list[tuple[Path, np.ndarray]]:
    """Return the files that a `.conf` lists, and world_from_scan `[4, 4]` of each."""
    if not conf.is_file():
        raise ValueError(f"{conf}: no such file; expected the .conf of some range scans")
    lines = [(number, line.split()) for number, line in enumerate(conf.read_text().splitlines(), 1)]
    scans = [_scan(conf, number, words) for number, words in lines if words and words[0] in ("bmesh", "mesh")]
    if not scans:
        raise ValueError(f"{conf}: no scans; expected lines `bmesh FILE tx ty tz qx qy qz qw`")
    return scans


def _scan(conf: Path, number: int, words: list[str]) -> tuple[Path, np.ndarray]:
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
    return path, world_from_scan


def _read_scan(path: Path) -> np.ndarray:
    geometry = read_geometry(path)
    return np.asarray(geometry.vertices if isinstance(geometry, trimesh.Trimesh) else geometry, np.float32)


def _fused(conf: Path) -> np.ndarray:
    clouds = [scan.points @ scan.world_from_scan[:3, :3].T + scan.world_from_scan[:3, 3] for scan in read_scans(conf)]
    points = np.concatenate(clouds)
    cell = np.ptp(points, axis=0).max() * _CELL
    if not cell > 0:
        return points
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)].astype(np.float32)
