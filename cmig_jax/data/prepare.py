"""Preparation: sample points and normals of every object, render its views (Sec. III-A), and write them to disk, once.

One process per core makes one shard at a time. A shard is written to temporary files, flushed, renamed, and only then recorded as
complete: after an interruption, the same command continues and makes the same bytes. On a prepared folder the command compares all
checksums and remakes only the shards that are missing, changed, or of an earlier version without normals. `shards.py` describes the
files.
"""

from __future__ import annotations

import errno
import hashlib
import json
import multiprocessing
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.raw import RawDataset
from cmig_jax.data.shard_jobs import Job, explaining_a_full_disk, names_and_labels, run_here, run_in_workers
from cmig_jax.data.shards import (
    FORMAT,
    MANIFEST,
    check_settings,
    completed_shards,
    find_fault,
    locked,
    settings_of,
    write_manifest,
)
from cmig_jax.data.sources import open_objects

OBJECTS_PER_SHARD = 64


def prepare(data: DataConfig, views: ViewsConfig, out: str | Path, *, workers: int | None = None, progress: bool = True) -> Path:
    """Prepare objects; continue or repair a folder that is there.

    The points and views of an object depend on the settings and the object only, not on the number of workers.

    Args:
        data: flags of the objects and of their number of points.
        views: flags of the views to render ahead of time.
        out: folder to write to.
        workers: number of processes; by default one per core. With 1, this process does the work.
        progress: show a progress bar.

    Returns:
        The folder.

    Raises:
        ValueError: raw data that cannot be read or sent to workers, a folder that was prepared with other settings, or `workers` below 1.
        OSError: too little space; the message has the folder, the bytes needed and the bytes free, and no file is left incomplete. Or
            a worker that ended early, as in a script that calls this without `if __name__ == "__main__":`.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # a worker that imports the script would wait for its parent
        raise RuntimeError("a script that prepares data needs `if __name__ == '__main__':`, since its workers import it")
    if workers is not None and workers < 1:
        raise ValueError(f"workers = {workers}: expected at least 1 process")
    out, settings, raw = Path(out), settings_of(data, views), open_objects(data)
    out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        jobs = _plan(data, views, raw, out, completed_shards(out, settings))
        _check_space(out, jobs)
        workers = min(workers or available_cores(), len(jobs))
        with tqdm(total=len(raw.objects), desc=f"prepare {out}", unit="object", disable=not progress) as bar:
            made = run_here(jobs, raw, bar) if workers <= 1 else run_in_workers(jobs, raw, workers, bar)
        with explaining_a_full_disk(out, 0):
            write_manifest(out, settings, raw.categories, made)
    return out


def ensure_prepared(data: DataConfig, views: ViewsConfig) -> Path:
    """Return the prepared folder of some flags; prepare it first if it has no manifest.

    Raises:
        ValueError: the folder was prepared with other settings, or the raw data cannot be read.
    """
    folder = prepared_folder(data, views)
    if not (folder / MANIFEST).exists():
        prepare(data, views, folder)
    check_settings(folder, data, views)
    return folder


def prepared_folder(data: DataConfig, views: ViewsConfig) -> Path:
    """Return `data.prepared`, or `data/<source>-<hash of the settings that the arrays depend on>`."""
    if data.prepared:
        return Path(data.prepared)
    text = json.dumps([FORMAT, settings_of(data, views)], sort_keys=True)
    return Path("data") / f"{data.source}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def available_cores() -> int:
    """Return the number of cores that this process may use, or of the machine where the system does not say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _plan(data: DataConfig, views: ViewsConfig, raw: RawDataset, out: Path, completed: dict[str, dict[str, Any]]) -> list[Job]:
    """Divide the objects into shards; keep completed shards of the same objects, with normals."""
    points, rendered = _stored_points(data, raw), views if views.of == "object" else None
    jobs = []
    for split in ("train", "test"):
        indices = [i for i, item in enumerate(raw.objects) if item.split == split]
        for start in range(0, len(indices), OBJECTS_PER_SHARD):
            name, chosen = f"{split}-{start // OBJECTS_PER_SHARD:05d}", tuple(indices[start : start + OBJECTS_PER_SHARD])
            known = completed.get(name)
            if known and ((known["names"], known["labels"]) != names_and_labels(raw, chosen) or "normals" not in known["files"]):
                known = None
            jobs.append(Job(out, name, settings_of(data, views), points, rendered, chosen, known))
    return jobs


def _stored_points(data: DataConfig, raw: RawDataset) -> int:
    """Return P: enough for two independent samplings, but no more than a cloud in random order has."""
    if not raw.objects:
        raise ValueError(f"data.source = {data.source}, data.root = {data.root}: 0 objects; expected at least 1")
    wanted = 2 * max(1024, data.most_points)
    if not raw.objects[0].shuffled:
        return wanted
    geometry = raw.objects[0].geometry()
    return min(wanted, len(geometry)) if isinstance(geometry, np.ndarray) else wanted


def _check_space(out: Path, jobs: list[Job]) -> None:
    """Raise OSError if the disk has too little space for the shards that are to be made."""
    needed = sum(sum(job.file_bytes().values()) for job in jobs if not job.known or find_fault(out, job.known, checksum=False))
    free = shutil.disk_usage(out).free
    if needed > free:
        raise OSError(errno.ENOSPC, f"{out}: {needed} bytes needed, {free} free")


if __name__ == "__main__":
    import sys

    from cmig_jax.cli import module_entry

    sys.exit(module_entry("prepare", "cmig_jax.data.prepare"))
