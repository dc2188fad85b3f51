"""Prepared objects on disk: the format, and its reader.

A prepared folder holds `manifest.json` and, per shard of n objects, two memory-mappable arrays:

    <split>-00000.points.npy   [n, P, 3] float32, points on the surface, in the unit sphere
    <split>-00000.views.npy    [n, V, H, W] uint8, depth views (Sec. III-A); only where `views.of` is `object`

The manifest has every setting that the arrays depend on, the categories, and per split the shards with labels, names and, per file,
size and SHA-256. It is written last, so a folder with a manifest was prepared to its end.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Literal

import numpy as np

from cmig_jax.config import Config

FORMAT = 1
MANIFEST = "manifest.json"
KEYS = {"settings", "categories", "distinct", "splits"}


class Shards:
    """One split of a prepared folder; arrays are mapped on first use, in each process anew.

    Args:
        folder: a prepared folder.
        split: `train` or `test`.
        verify: compare every file's size, or also its checksum, with the manifest.

    Attributes:
        labels: `[n]` int64 category of each object, an index into `categories`.
        names: name of each object.
        categories: names of the categories.

    Raises:
        ValueError: no manifest, an unknown split, or a shard that is missing, truncated or changed; the message has the repairing command.
    """

    def __init__(self, folder: str | Path, split: str, *, verify: Literal["size", "checksum"] = "size") -> None:
        self.folder, self.split = Path(folder), split
        self._manifest = read_manifest(self.folder)
        if split not in self._manifest["splits"]:
            raise ValueError(f"split {split!r} of {self.folder}: expected one of {', '.join(self._manifest['splits'])}")
        self._shards: list[dict[str, Any]] = self._manifest["splits"][split]
        for shard in self._shards:
            if fault := find_fault(self.folder, shard, checksum=verify == "checksum"):
                raise ValueError(self._with_repair(fault))
        self.categories: tuple[str, ...] = tuple(self._manifest["categories"])
        self.labels = np.array([label for shard in self._shards for label in shard["labels"]], np.int64)
        self.names: tuple[str, ...] = tuple(name for shard in self._shards for name in shard["names"])
        self._starts = np.cumsum([0] + [len(shard["labels"]) for shard in self._shards])
        self._mapped: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.names)

    def points(self, i: int) -> np.ndarray:
        """Return the points of object i: `[P, 3]` float32, read only."""
        found = self._row(i, "points")
        assert found is not None
        return found

    def views(self, i: int) -> np.ndarray | None:
        """Return the depth views of object i: `[V, H, W]` uint8, read only; None where observed clouds are rendered instead."""
        return self._row(i, "views")

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_mapped": {}}

    def _row(self, i: int, kind: str) -> np.ndarray | None:
        if not 0 <= i < len(self):
            raise IndexError(f"object {i} of {len(self)}")
        number = int(np.searchsorted(self._starts, i, side="right")) - 1
        file = self._shards[number]["files"].get(kind)
        if file is None:
            return None
        if file["name"] not in self._mapped:
            try:
                mapped = np.load(self.folder / file["name"], mmap_mode="r")
            except (OSError, ValueError) as error:
                raise ValueError(self._with_repair(f"{self.folder / file['name']} cannot be read ({error})")) from error
            self._mapped[file["name"]] = np.asarray(mapped)
        return self._mapped[file["name"]][i - self._starts[number]]

    def _with_repair(self, fault: str) -> str:
        return f"{fault}; repair it with: {repair_command(self._manifest['settings'], self.folder)}"


def settings_of(config: Config) -> dict[str, Any]:
    """Return the settings that prepared arrays depend on, named like their flags.

    Up to 1,024 points are always prepared, so that smaller `data.points` share a folder. Flags that do not matter are left out.
    """
    data, views = config.data, config.views
    settings: dict[str, Any] = {"data.source": data.source, "data.points": max(1024, data.points)}
    if data.root is not None:
        settings["data.root"] = str(Path(data.root).expanduser().resolve())
    if data.source == "shapes":
        settings["data.shapes"] = data.shapes
    if views.of == "object":
        settings |= {"views.of": views.of, "views.count": views.count, "views.size": views.size, "views.layout": views.layout}
    else:
        settings["views.of"] = "source"  # observed clouds are rendered in training: nothing is stored
    return settings


def check_settings(folder: Path, config: Config) -> None:
    """Refuse a prepared folder that was made with other settings than a config's.

    More points than the config needs are fine, views that it does not need are fine, and so is another place of the raw data.

    Raises:
        ValueError: naming the flag, its value in the folder, and its value in the config.
    """
    manifest = read_manifest(folder)
    made, wanted = manifest["settings"], settings_of(config)
    per_object = config.data.points * (2 if config.data.sampling == "twice" else 1)
    if manifest["distinct"] < per_object:
        detail = f"data.points = {config.data.points} with data.sampling = {config.data.sampling}"
        raise ValueError(f"{detail} needs {per_object} points of every object, but {folder} has objects of {manifest['distinct']}")
    names = ["data.source", "data.shapes"]
    if config.views.of == "object":
        names += ["views.of", "views.count", "views.size", "views.layout"]
    for name in names:
        if made.get(name) != wanted.get(name):
            raise ValueError(
                f"{name} = {wanted.get(name)}, but {folder} was prepared with {name} = {made.get(name)}: "
                "name another folder (data.prepared), or change the flag"
            )


def repair_command(settings: Mapping[str, Any], folder: Path) -> str:
    """Return the command that checks a prepared folder and remakes what is missing or changed."""
    flags = [part for name, value in settings.items() for part in (f"--{name}", str(value))]
    return shlex.join(["python", "-m", "cmig_jax.data.prepare", *flags, "--out", str(folder)])


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read `manifest.json`.

    Raises:
        ValueError: there is none, or it is not one of this format.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise ValueError(f"{path} is missing: {folder} was not prepared to its end (python -m cmig_jax.data.prepare --help)")
    try:
        manifest = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not JSON ({error}): delete it and prepare the folder again") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or not manifest.keys() >= KEYS:
        raise ValueError(f"{path}: expected a manifest of format {FORMAT}; prepare the objects into another folder")
    return manifest


def finished_shards(folder: Path, settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the shards that are in the manifest or, where a preparation was interrupted, in the notes; by name.

    Raises:
        ValueError: they were made with other settings.
    """
    notes = [json.loads(path.read_text()) for path in sorted(folder.glob("*-?????.json"))]
    if (folder / MANIFEST).exists():
        manifest = read_manifest(folder)
        notes = [{**manifest, "shard": shard} for shards in manifest["splits"].values() for shard in shards] + notes
    for made in (note["settings"] for note in notes):
        for name in sorted(set(made) | set(settings)):
            if made.get(name) != settings.get(name):
                fault = f"{name} = {settings.get(name)}, but {folder} was prepared with {name} = {made.get(name)}"
                raise ValueError(f"{fault}: choose another folder")
    return {note["shard"]["name"]: note["shard"] for note in notes}


def write_note(folder: Path, settings: Mapping[str, Any], shard: Mapping[str, Any]) -> None:
    """Note that a shard is finished, until the manifest says so."""
    with replacing(folder / f"{shard['name']}.json") as file:
        file.write(json.dumps({"format": FORMAT, "settings": settings, "shard": shard}).encode())


def write_manifest(folder: Path, settings: Mapping[str, Any], categories: Sequence[str], shards: Sequence[dict[str, Any]]) -> None:
    """Write the manifest, then remove the notes that it replaces and what an interruption left."""
    splits = {split: [shard for shard in shards if shard["name"].startswith(split)] for split in ("train", "test")}
    manifest = {
        "format": FORMAT,
        "settings": settings,
        "categories": list(categories),
        "distinct": min(shard["distinct"] for shard in shards),
        "objects": {split: sum(len(shard["names"]) for shard in found) for split, found in splits.items()},
        "splits": {split: found for split, found in splits.items() if found},
    }
    with replacing(folder / MANIFEST) as file:
        file.write(json.dumps(manifest, indent=1).encode())
    for path in (*folder.glob("*-?????.json"), *folder.glob("*.partial")):
        path.unlink()


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Write a file under a temporary name, flush it to the disk, and rename it; on any error leave nothing."""
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def only_one(folder: Path) -> Iterator[None]:
    """Wait until no other process prepares this folder; the lock ends with the process, however it ends."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def find_fault(folder: Path, shard: Mapping[str, Any], *, checksum: bool) -> str | None:
    """Return what is wrong with a shard's files, naming the file, or None."""
    for file in shard["files"].values():
        path = folder / file["name"]
        if not path.is_file():
            return f"{path} is missing"
        if path.stat().st_size != file["bytes"]:
            return f"{path} has {path.stat().st_size} bytes instead of {file['bytes']}"
        if checksum and sha256(path) != file["sha256"]:
            return f"{path} has changed: its checksum is not that of the manifest"
    return None


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
