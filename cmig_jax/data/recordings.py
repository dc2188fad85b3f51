"""Recordings on disk: what a sensor saw of a scene from several places, and which two of them overlap.

`stanford-scans`: the raw range scans that a `.conf` joins; any two of them may make a pair. `sevenscenes-fragments`: fragments of 50
frames of the test scenes (Sec. IV-D); those that follow each other may. Two recordings are a pair, in either order, where at least the
share `OVERLAP` of each has a point of the other closer than `NEAR` under the true pose.

A prepared folder holds, beside a `<name>.npy` `[P, 3]` float32 of every recording in its sensor's frame and the units of the source,
`pairs.json`: settings, categories, recordings with their poses, and pairs with their overlap. It is written last.
"""

from __future__ import annotations

import hashlib
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from tqdm import tqdm

from cmig_jax.config import DataConfig
from cmig_jax.data.raw import RecordedDataset, check_points
from cmig_jax.data.sample import normalise_together
from cmig_jax.data.sevenscenes import open_fragments
from cmig_jax.data.shards import only_one, replacing
from cmig_jax.data.stanford import open_scans

SOURCES = ("stanford-scans", "sevenscenes-fragments")
"""The values of `data.source` that are recordings."""
FORMAT = 1
MANIFEST = "pairs.json"
KEYS = {"settings", "categories", "recordings", "pairs"}
OVERLAP = 0.3
NEAR = 0.02
"""In units of the pair, whose larger cloud is scaled to the unit sphere: 2 mm for the Stanford bunny, 3.5 cm for a room."""
_ASKED = 5000  # points of a cloud that are asked for their neighbour, evenly spaced: the share is exact to about 0.01


def open_recordings(data: DataConfig) -> RecordedDataset:
    """Open the recordings that the flags name; names and poses are read now, clouds when they are asked for.

    Raises:
        ValueError: another source, a missing folder or file, or one that is not as the source expects; the message names it.
    """
    match data.source:
        case "stanford-scans":
            return open_scans(data.root)
        case "sevenscenes-fragments":
            return open_fragments(data.root)
        case _:
            raise ValueError(f"data.source = {data.source}: expected {' or '.join(SOURCES)}")


def ensure_recordings(data: DataConfig, *, progress: bool = True) -> Path:
    """Return the prepared folder of recordings; prepare it first, or to its end, if it has no manifest.

    Args:
        data: `source`, `root`, `prepared`.
        progress: show a bar.

    Raises:
        ValueError: the folder was prepared from another source, raw data that cannot be read, or no two recordings that overlap.
    """
    settings = {"data.source": data.source, "data.root": data.root and str(Path(data.root).expanduser().resolve())}
    digest = hashlib.sha256(json.dumps([FORMAT, settings], sort_keys=True).encode()).hexdigest()[:8]
    folder = Path(data.prepared) if data.prepared else Path("data") / f"{data.source}-{digest}"
    if not (folder / MANIFEST).exists():
        recorded = open_recordings(data)
        folder.mkdir(parents=True, exist_ok=True)
        with only_one(folder):
            _prepare(recorded, settings, folder, progress)
    if (made := read_manifest(folder)["settings"]["data.source"]) != data.source:
        raise ValueError(
            f"data.source = {data.source}, but {folder} was prepared with data.source = {made}: "
            "name another folder (data.prepared), or change the flag"
        )
    return folder


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read `pairs.json`.

    Raises:
        ValueError: there is none, or it is not one of this format.
    """
    path = folder / MANIFEST
    try:
        manifest = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not readable ({error}); delete it, and it is made anew") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or not manifest.keys() >= KEYS:
        raise ValueError(f"{path}: expected a manifest of format {FORMAT}; name another folder (data.prepared)")
    return manifest


def read_recording(folder: Path, file: str) -> np.ndarray:
    """Read a prepared cloud `[P, 3]`.

    Raises:
        ValueError: missing or damaged.
    """
    try:
        return check_points(np.load(folder / file), folder / file)
    except (OSError, EOFError, ValueError) as error:
        raise ValueError(f"{folder / file}: not readable ({error}); delete it and {folder / MANIFEST}, and both are made anew") from error


def between(world_from_source: np.ndarray, world_from_target: np.ndarray) -> np.ndarray:
    """Return target_from_source `[4, 4]` of two rigid `[4, 4]`, its rotation exact.

    Raises:
        ValueError: the result is not rigid.
    """
    target_from_source = np.linalg.inv(world_from_target) @ world_from_source
    u, stretch, vh = np.linalg.svd(target_from_source[:3, :3])
    if np.abs(stretch - 1).max() > 1e-2 or np.linalg.det(u @ vh) < 0:
        raise ValueError(f"target_from_source = {target_from_source.tolist()}: expected a rotation and a translation")
    target_from_source[:3, :3] = u @ vh
    return target_from_source


def overlap(source: np.ndarray, target: np.ndarray, target_from_source: np.ndarray) -> float:
    """Return the smaller of the two shares of a cloud whose points have one of the other cloud nearer than `NEAR`.

    Args:
        source: `[N, 3]`, any unit.
        target: `[M, 3]`, the same unit.
        target_from_source: `[4, 4]`, the true transform, in that unit.
    """
    near = NEAR * normalise_together(source, target)[-1]
    moved = source @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    shares = []
    for one, other in ((moved, target), (target, moved)):
        distance, _ = KDTree(other, balanced_tree=False).query(one[:: 1 + len(one) // _ASKED], distance_upper_bound=near)
        shares.append(np.mean(distance < near))
    return float(min(shares))


def _prepare(recorded: RecordedDataset, settings: dict[str, Any], folder: Path, progress: bool) -> None:
    """Write the clouds that are not there yet, then the manifest."""
    files = [_file_name(recording.name) for recording in recorded.recordings]
    for recording, file in zip(tqdm(recorded.recordings, f"prepare {folder}", unit="cloud", disable=not progress), files, strict=True):
        if not (folder / file).exists():
            cloud = check_points(recording.read(), recording.name)
            with replacing(folder / file) as opened:
                np.save(opened, cloud.astype(np.float32))
    poses = [recording.world_from_sensor for recording in recorded.recordings]
    pairs = []
    for i, j in tqdm(recorded.candidates, "overlaps", unit="pair", disable=not progress):
        share = overlap(read_recording(folder, files[i]), read_recording(folder, files[j]), between(poses[i], poses[j]))
        pairs += [[i, j, share], [j, i, share]] if share >= OVERLAP else []
    if not pairs:
        raise ValueError(
            f"{settings['data.root']}: none of {len(recorded.candidates)} candidate pairs of {len(files)} recordings overlaps "
            f"by {OVERLAP}; expected at least one"
        )
    manifest = {
        "format": FORMAT,
        "settings": settings,
        "categories": list(recorded.categories),
        "recordings": [
            {"name": r.name, "label": r.label, "file": file, "world_from_sensor": r.world_from_sensor.tolist()}
            for r, file in zip(recorded.recordings, files, strict=True)
        ],
        "pairs": pairs,
    }
    with replacing(folder / MANIFEST) as opened:
        opened.write(json.dumps(manifest, indent=1).encode())


def _file_name(name: str) -> str:
    return f"{re.sub(r'[^A-Za-z0-9]+', '-', name)}-{zlib.crc32(name.encode()):08x}.npy"
