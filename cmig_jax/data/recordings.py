"""Recordings on disk: clouds that a sensor saw of a scene from several places, and which two of them overlap.

Two candidates of a source (`RecordedDataset.candidates`) are a pair, in either order, if at least the share `OVERLAP` of each has a
point of the other closer than `NEAR` under the true pose.

A prepared folder holds a `<name>.npy` `[P, 3]` float32 of every recording, in its sensor's frame and the units of the source, and
`pairs.json`: settings, categories, recordings with their poses, and pairs with their overlap. `pairs.json` is written last.
"""

from __future__ import annotations

import hashlib
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cmig_jax.clouds import check_cloud
from cmig_jax.config import DataConfig
from cmig_jax.data.overlap import overlap
from cmig_jax.data.raw import RecordedDataset
from cmig_jax.data.sample import normalise_pair
from cmig_jax.data.shards import locked
from cmig_jax.data.sources import open_recordings
from cmig_jax.files import DAMAGED, remove_partial_files, replacing, write_text

FORMAT = 1
MANIFEST = "pairs.json"
KEYS = {"settings", "categories", "recordings", "pairs"}
OVERLAP = 0.3
NEAR = 0.02
"""In units of the pair, whose larger cloud is scaled to the unit sphere: 2 mm for the Stanford bunny, 3.5 cm for a room."""


def ensure_recordings(data: DataConfig, *, progress: bool = True) -> Path:
    """Return the prepared folder of recordings; prepare it first, or complete it, if it has no manifest.

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
        with locked(folder):
            if not (folder / MANIFEST).exists():  # no other process has made it in the meantime
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
        raise ValueError(f"{path}: not readable ({error}); delete it, and the next run prepares the folder again") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or not manifest.keys() >= KEYS:
        raise ValueError(f"{path}: expected a manifest of format {FORMAT}; name another folder (data.prepared)")
    return manifest


def read_recording(folder: Path, file: str) -> np.ndarray:
    """Read a prepared cloud `[P, 3]`.

    Raises:
        ValueError: missing or damaged.
    """
    try:
        return check_cloud(np.load(folder / file), folder / file)
    except DAMAGED as error:
        repair = f"delete it and {folder / MANIFEST}, and the next run makes both again"
        raise ValueError(f"{folder / file}: not readable ({error}); {repair}") from error


def between(world_from_source: np.ndarray, world_from_target: np.ndarray, name: str = "pair") -> np.ndarray:
    """Return target_from_source `[4, 4]` of two poses `[4, 4]`, with its rotation made orthonormal; `name` is that of the pair in an error.

    Raises:
        ValueError: the result is not rigid.
    """
    target_from_source = np.linalg.inv(world_from_target) @ world_from_source
    u, stretch, vh = np.linalg.svd(target_from_source[:3, :3])
    if np.abs(stretch - 1).max() > 1e-2 or np.linalg.det(u @ vh) < 0:
        raise ValueError(f"{name}: target_from_source = {target_from_source.tolist()}: expected a rotation and a translation")
    target_from_source[:3, :3] = u @ vh
    return target_from_source


def _prepare(recorded: RecordedDataset, settings: dict[str, Any], folder: Path, progress: bool) -> None:
    """Write the clouds that are missing, then the manifest; remove the temporary files of processes that were killed."""
    files = [_file_name(recording.name) for recording in recorded.recordings]
    for recording, file in zip(tqdm(recorded.recordings, f"prepare {folder}", unit="cloud", disable=not progress), files, strict=True):
        if not (folder / file).exists():
            cloud = check_cloud(recording.read(), recording.name)
            with replacing(folder / file) as opened:
                np.save(opened, cloud.astype(np.float32))
    poses = [recording.world_from_sensor for recording in recorded.recordings]
    pairs = []
    for i, j in tqdm(recorded.candidates, "overlaps", unit="pair", disable=not progress):
        pose = between(poses[i], poses[j], f"{recorded.recordings[i].name} to {recorded.recordings[j].name}")
        clouds = read_recording(folder, files[i]), read_recording(folder, files[j])
        share = overlap(*clouds, pose[:3, :3], pose[:3, 3], NEAR * normalise_pair(*clouds).scale)
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
    write_text(folder / MANIFEST, json.dumps(manifest, indent=1))
    remove_partial_files(folder)


def _file_name(name: str) -> str:
    return f"{re.sub(r'[^A-Za-z0-9]+', '-', name)}-{zlib.crc32(name.encode()):08x}.npy"
