"""The Stanford 3D Scanning Repository (Sec. IV-D): reconstructed models, and raw range scans with their poses.

Download: the reconstructed models (`bun_zipper.ply`, `dragon_vrip.ply`, ...) and the raw range data of a model (`bunny/data/` with
`bun.conf`). A `.conf` file lists the scans: `bmesh FILE tx ty tz qx qy qz qw` means x_world = R(q)^T x_scan + t, in metres.
`docs/data.md` says where they go.
"""

from __future__ import annotations

import functools
import itertools
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig
from cmig_jax.data.geometry_files import read_geometry, read_object_and_normals
from cmig_jax.data.raw import RawDataset, RawObject, RecordedDataset, Recording, Source, existing_folder, visible_files

_CELL = 1 / 400  # share of the extent of fused scans; one point per cell is kept, so that regions in many scans are not denser


def open_models(data: DataConfig) -> RawDataset:
    """Open every PLY model below a folder as a test object of the one category "scan"; there are no objects to train on.

    The scans of a folder with a `.conf` file are fused, in the world frame, into one object that is named after the folder. In a
    folder with several `.conf` files, each makes an object that is named after folder and file.

    Raises:
        ValueError: no such folder, or no PLY files in it.
    """
    folder = existing_folder(data.root, "a folder of PLY models, or of range scans with their .conf")
    confs, objects = visible_files(folder, "**/*.conf"), []
    for place in sorted({conf.parent for conf in confs}):
        name = folder.resolve().name if place == folder else place.relative_to(folder).as_posix()
        here = [conf for conf in confs if conf.parent == place]
        for conf in here:
            objects.append(RawObject(name if len(here) == 1 else f"{name}/{conf.stem}", 0, "test", functools.partial(_fused, conf)))
    scanned = {conf.parent for conf in confs}
    models = [path for path in visible_files(folder, "**/*.ply") if path.parent not in scanned]
    objects += [
        RawObject(path.relative_to(folder).as_posix(), 0, "test", functools.partial(read_object_and_normals, path)) for path in models
    ]
    if not objects:
        raise ValueError(f"{folder}: no *.ply and no *.conf in it; expected PLY models, or range scans with their .conf")
    return RawDataset(("scan",), tuple(objects))


def open_scans(data: DataConfig) -> RecordedDataset:
    """Open the range scans of every `.conf` below a folder: a scene each, any two of its scans a candidate.

    Raises:
        ValueError: no such folder, no `.conf` in it, or one with a malformed line, a zero quaternion, a missing file or no scans.
    """
    folder = existing_folder(data.root, "a folder of range scans with their .conf")
    confs = visible_files(folder, "**/*.conf")
    if not confs:
        raise ValueError(f"{folder}: no *.conf in it; expected range scans with their .conf")
    categories = tuple(conf.relative_to(folder).with_suffix("").as_posix() for conf in confs)
    recordings, candidates = [], []
    for label, conf in enumerate(confs):
        first = len(recordings)
        for path, world_from_scan in _listed(conf):
            name = f"{categories[label]}/{path.stem}"
            recordings.append(Recording(name, label, functools.partial(_read_scan, path), world_from_scan))
        candidates += itertools.combinations(range(first, len(recordings)), 2)
    return RecordedDataset(categories, tuple(recordings), tuple(candidates))


def _listed(conf: Path) -> list[tuple[Path, np.ndarray]]:
    """Return the files that a `.conf` lists, and world_from_scan `[4, 4]` of each."""
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
        if not np.isfinite(world_from_scan).all():
            raise ValueError("not finite")
    except ValueError as error:
        raise ValueError(f"{conf}, line {number}: {' '.join(words)!r} ({error}); expected bmesh FILE tx ty tz qx qy qz qw") from error
    path = conf.parent / words[1]
    if not path.is_file():
        raise ValueError(f"{path}: no such file; {conf}, line {number}, lists it")
    return path, world_from_scan


def _read_scan(path: Path) -> np.ndarray:
    return read_geometry(path).points.astype(np.float32)


def _fused(conf: Path) -> np.ndarray:
    clouds = [_read_scan(path) @ pose[:3, :3].T + pose[:3, 3] for path, pose in _listed(conf)]
    points = np.concatenate(clouds)
    cell = np.ptp(points, axis=0).max() * _CELL
    if not cell > 0:
        return points
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)].astype(np.float32)


MODELS = Source("stanford", open_models, trains=False, folder="stanford")
SCANS = Source("stanford-scans", open_scans, records=True, trains=False, folder="stanford")
