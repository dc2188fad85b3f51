"""Prepared objects on disk: the format, and its reader.

A prepared folder holds `manifest.json` and, per shard of n objects, up to three memory-mappable arrays:

    <split>-00000.points.npy   [n, P, 3] float32, points on the surface, in the unit sphere; a smaller cloud repeats its points
    <split>-00000.normals.npy  [n, P, 3] float32, unit normals of these points; not in folders of earlier versions
    <split>-00000.views.npy    [n, V, H, W] uint8, depth views (Sec. III-A); only where `views.of` is `object`

The manifest has the settings, the categories, and per split the shards with names, labels and numbers of distinct points of their
objects and, per file, size and SHA-256. It is written last, so a folder with a manifest is complete.
"""

from __future__ import annotations

import contextlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from filelock import FileLock

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.sources import source_of
from cmig_jax.files import DAMAGED, remove_partial_files, sha256, write_text

FORMAT = 2
MANIFEST = "manifest.json"
LOCK = ".lock"
NOTES = "*-[0-9][0-9][0-9][0-9][0-9].json"
KEYS = {"settings", "categories", "distinct", "splits"}


class Shards:
    """One split of a prepared folder; every process maps an array when it first reads it.

    Args:
        folder: a prepared folder.
        split: `train` or `test`.
        verify: compare every file's size, or also its checksum, with the manifest.

    Attributes:
        labels: `[n]` int64 category of each object, an index into `categories`.
        names: name of each object.
        categories: names of the categories.

    Raises:
        ValueError: no manifest, an unknown split, or a shard that is missing, truncated or changed; the message has the command that
            repairs it.
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
        self._distinct: list[int] = [number for shard in self._shards for number in shard["distinct"]]
        self._starts = np.cumsum([0] + [len(shard["labels"]) for shard in self._shards])
        self._mapped: dict[str, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self.names)

    def points(self, i: int) -> np.ndarray:
        """Return the points of object i without repetitions: `[P, 3]` float32, read only."""
        found = self._row(i, "points")
        assert found is not None
        return found[: self._distinct[i]]

    def normals(self, i: int) -> np.ndarray:
        """Return the unit normals of `points(i)`: `[P, 3]` float32, read only.

        Raises:
            ValueError: as `check_normals`.
        """
        found = self._row(i, "normals")
        if found is None:
            self.check_normals()
        assert found is not None
        return found[: self._distinct[i]]

    def check_normals(self) -> None:
        """Raise ValueError, with the command that adds them, if an earlier version has prepared this folder without normals."""
        if any("normals" not in shard["files"] for shard in self._shards):
            command = repair_command(self._manifest["settings"], self.folder)
            raise ValueError(f"{self.folder} was prepared by an earlier version, without normals; add them with: {command}")

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
            except DAMAGED as error:
                raise ValueError(self._with_repair(f"{self.folder / file['name']} cannot be read ({error})")) from error
            self._mapped[file["name"]] = np.asarray(mapped)
        return self._mapped[file["name"]][i - self._starts[number]]

    def _with_repair(self, fault: str) -> str:
        return f"{fault}; repair it with: {repair_command(self._manifest['settings'], self.folder)}"


def settings_of(data: DataConfig, views: ViewsConfig) -> dict[str, Any]:
    """Return the settings that prepared arrays depend on, by the names of their flags.

    At least 1,024 points are prepared, so that all smaller values of `data.points` share a folder; more where `data.keep_least` needs them.
    """
    settings: dict[str, Any] = {"data.source": data.source, "data.points": max(1024, data.most_points)}
    if data.root is not None:
        settings["data.root"] = str(Path(data.root).expanduser().resolve())
    settings |= {f"data.{flag}": getattr(data, flag) for flag in source_of(data).flags}
    if views.of == "object":
        settings |= {"views.of": views.of, "views.count": views.count, "views.size": views.size, "views.layout": views.layout}
    else:
        settings["views.of"] = "source"  # for all views of observed clouds, which are rendered with the pair and not stored
    return settings


def check_settings(folder: Path, data: DataConfig, views: ViewsConfig) -> None:
    """Check that a prepared folder was made with the settings of these flags.

    More points than needed, views that are not needed, and another folder of raw data are accepted.

    Raises:
        ValueError: naming the flag, its value in the folder, and its value in the flags.
    """
    manifest = read_manifest(folder)
    made, wanted = manifest["settings"], settings_of(data, views)
    per_object = data.most_points * (2 if data.sampling == "twice" else 1)
    if manifest["distinct"] < per_object:
        detail = f"data.points = {data.points} with data.sampling = {data.sampling}"
        detail += f" and data.keep_least = {data.keep_least}" if data.keep_least else ""
        raise ValueError(f"{detail} needs {per_object} points of every object, but {folder} has objects of {manifest['distinct']}")
    names = ["data.source", *(f"data.{flag}" for flag in source_of(data).flags)]
    if views.of == "object":
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
    return shlex.join(["cmig", "prepare", *flags, "--out", str(folder)])


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read `manifest.json`.

    Raises:
        ValueError: there is none, or it is not one of this format.
    """
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise ValueError(f"{path} is missing: expected a prepared folder (cmig prepare --help)")
    try:
        manifest = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is not JSON ({error}): delete it and prepare the folder again") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT or not manifest.keys() >= KEYS:
        raise ValueError(f"{path}: expected a manifest of format {FORMAT}; prepare the objects into another folder")
    return manifest


def completed_shards(folder: Path, settings: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the shards in the manifest or, where a preparation was interrupted, in the notes of `write_note`; by name.

    Raises:
        ValueError: they were made with other settings.
    """
    notes = [json.loads(path.read_text()) for path in sorted(folder.glob(NOTES))]
    notes = [note for note in notes if note["format"] == FORMAT]
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
    """Record that a shard is complete; the manifest will replace these notes."""
    write_text(folder / f"{shard['name']}.json", json.dumps({"format": FORMAT, "settings": settings, "shard": shard}))


def write_manifest(folder: Path, settings: Mapping[str, Any], categories: Sequence[str], shards: Sequence[dict[str, Any]]) -> None:
    """Write the manifest, then remove the notes that it replaces and the temporary files of processes that were killed."""
    splits = {split: [shard for shard in shards if shard["name"].startswith(split)] for split in ("train", "test")}
    manifest = {
        "format": FORMAT,
        "settings": settings,
        "categories": list(categories),
        "distinct": min(min(shard["distinct"]) for shard in shards),
        "objects": {split: sum(len(shard["names"]) for shard in found) for split, found in splits.items()},
        "splits": {split: found for split, found in splits.items() if found},
    }
    write_text(folder / MANIFEST, json.dumps(manifest, indent=1))
    for path in folder.glob(NOTES):
        path.unlink()
    remove_partial_files(folder)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Prevent other processes from preparing this folder, after waiting for one that does; a process that is killed loses the lock."""
    with FileLock(folder / LOCK):
        yield


def find_fault(folder: Path, shard: Mapping[str, Any], *, checksum: bool) -> str | None:
    """Return the fault of a shard's files, with the name of the file, or None."""
    for file in shard["files"].values():
        path = folder / file["name"]
        if not path.is_file():
            return f"{path} is missing"
        if path.stat().st_size != file["bytes"]:
            return f"{path} has {path.stat().st_size} bytes instead of {file['bytes']}"
        if checksum and sha256(path) != file["sha256"]:
            return f"{path} has changed: its checksum is not that of the manifest"
    return None
