"""Objects to shards, once: sample points on every object, render its views (Sec. III-A), and write both to disk.

    python -m cmig_jax.data.prepare --data.source modelnet40-hdf5 --data.root FOLDER --out PREPARED

One process per core makes one shard at a time. A shard is written under temporary names, flushed, renamed, and only then noted as
finished: whatever interrupts a preparation, the same command continues it and makes the same bytes. On a prepared folder the command
compares all checksums and remakes only the shards that are missing or changed. `shards.py` describes the files.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import errno
import hashlib
import json
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from cmig_jax.config import Config, DataConfig, KeypointsConfig, ModelConfig, PointsConfig, ViewsConfig
from cmig_jax.data.readers import RawDataset, RawObject, open_raw
from cmig_jax.data.render import render_views
from cmig_jax.data.sample import normalise, object_points
from cmig_jax.data.shards import (
    FORMAT,
    MANIFEST,
    Shards,
    check_settings,
    find_fault,
    finished_shards,
    only_one,
    read_manifest,
    replacing,
    settings_of,
    sha256,
    write_manifest,
    write_note,
)

OBJECTS_PER_SHARD = 64
DENSE_POINTS = 16384
"""Points that a mesh is rendered from."""


def prepare(config: Config, out: str | Path, *, workers: int | None = None, progress: bool = True) -> Path:
    """Prepare the objects of `config.data` with the views of `config.views`; continue or repair what is there.

    The points and views of an object depend on the settings and the object only, not on the number of workers.

    Args:
        config: only `data` and `views` matter.
        out: the folder to fill.
        workers: processes; by default one per core. 1 works in this process.
        progress: show a progress bar.

    Returns:
        The folder.

    Raises:
        ValueError: raw data that cannot be read, a folder that was prepared with other settings, or less than one worker.
        OSError: too little space, naming the folder, the bytes needed and the bytes free. Nothing is left half-written.
            Or a worker that ended early, as in a script that calls this without `if __name__ == "__main__":`.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):  # a worker that imports the script; it would wait for its parent
        raise RuntimeError("a script that prepares data needs `if __name__ == '__main__':`, since its workers import it")
    if workers is not None and workers < 1:
        raise ValueError(f"workers = {workers}: expected at least 1 process")
    out = Path(out)
    settings = settings_of(config)
    raw = open_raw(config.data)
    out.mkdir(parents=True, exist_ok=True)
    with only_one(out):
        jobs = _plan(config, raw, out, finished_shards(out, settings))
        _check_space(out, jobs)
        workers = min(workers or len(os.sched_getaffinity(0)), len(jobs))
        with tqdm(total=len(raw.objects), desc=f"prepare {out}", unit="object", disable=not progress) as bar:
            made = _run_here(jobs, raw, bar) if workers <= 1 else _run_in_workers(jobs, config.data, workers, bar)
        with _explaining_a_full_disk(out, 0):
            write_manifest(out, settings, raw.categories, made)
    return out


def ensure_prepared(config: Config) -> Path:
    """Return the prepared folder of a config; prepare it first if it has no manifest.

    Raises:
        ValueError: the folder was prepared with other settings, or the raw data cannot be read.
    """
    folder = Path(config.data.prepared) if config.data.prepared else default_prepared_folder(config)
    if not (folder / MANIFEST).exists():
        prepare(config, folder)
    check_settings(folder, config)
    return folder


def default_prepared_folder(config: Config) -> Path:
    """Return `data/<source>-<hash of the settings that the arrays depend on>`."""
    text = json.dumps([FORMAT, settings_of(config)], sort_keys=True)
    return Path("data") / f"{config.data.source}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


@dataclass(frozen=True)
class _Job:
    """One shard to make, or, where `known` is set, to verify first."""

    out: Path
    name: str
    settings: dict[str, Any]
    points: int
    views: ViewsConfig | None
    objects: tuple[int, ...]
    known: dict[str, Any] | None

    def file_bytes(self) -> dict[str, int]:
        """Return the sizes of the arrays, without their headers."""
        sizes = {"points": len(self.objects) * self.points * 3 * 4}
        if self.views is not None:
            sizes["views"] = len(self.objects) * self.views.count * self.views.size**2
        return sizes


def _plan(config: Config, raw: RawDataset, out: Path, finished: dict[str, dict[str, Any]]) -> list[_Job]:
    """Divide the objects into shards; take over what is finished, as long as it is of the same objects."""
    points, views = _stored_points(config, raw), config.views if config.views.of == "object" else None
    jobs = []
    for split in ("train", "test"):
        indices = [i for i, item in enumerate(raw.objects) if item.split == split]
        for start in range(0, len(indices), OBJECTS_PER_SHARD):
            name, chosen = f"{split}-{start // OBJECTS_PER_SHARD:05d}", tuple(indices[start : start + OBJECTS_PER_SHARD])
            known = finished.get(name)
            if known and (known["names"], known["labels"]) != _names_and_labels(raw, chosen):
                known = None
            jobs.append(_Job(out, name, settings_of(config), points, views, chosen, known))
    return jobs


def _stored_points(config: Config, raw: RawDataset) -> int:
    """Return P: enough for two independent samplings, or all points of a cloud that comes in random order."""
    if not raw.objects:
        raise ValueError(f"data.root = {config.data.root}: there are no objects")
    wanted = 2 * max(1024, config.data.points)
    cloud = raw.objects[0].points if raw.objects[0].shuffled else None
    return wanted if cloud is None else min(wanted, len(cloud))


def _run_here(jobs: list[_Job], raw: RawDataset, bar: tqdm) -> list[dict[str, Any]]:
    made = []
    for job in jobs:
        made.append(_make_shard(job, raw, lambda: False))
        bar.update(len(job.objects))
    return made


def _run_in_workers(jobs: list[_Job], data: DataConfig, workers: int, bar: tqdm) -> list[dict[str, Any]]:
    """Run the jobs in fresh processes; on an error or Ctrl-C they stop after the object at hand."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    with concurrent.futures.ProcessPoolExecutor(workers, context, _start_worker, (data, stop)) as pool:
        try:
            # Ctrl-C reaches every process of a terminal: the workers inherit that it is blocked, and this process stops them.
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            try:
                futures = [pool.submit(_make_in_worker, job) for job in jobs]
            finally:
                signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            sizes = {future: len(job.objects) for future, job in zip(futures, jobs, strict=True)}
            for future in concurrent.futures.as_completed(futures):
                future.result()
                bar.update(sizes[future])
            return [future.result() for future in futures]
        except BrokenProcessPool as error:
            causes = "too little memory for so many workers, or a script without `if __name__ == '__main__':`"
            raise OSError(f"a process that prepared {jobs[0].out} has ended early: {causes}") from error
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


_worker: dict[str, Any] = {}


def _start_worker(data: DataConfig, stop: Any) -> None:
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    _worker.update(raw=open_raw(data), stop=stop)


def _end_with_the_parent() -> None:
    """Wait for the parent to end, and end this process: a pool's processes would wait for ever after a parent that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make_in_worker(job: _Job) -> dict[str, Any]:
    return _make_shard(job, _worker["raw"], _worker["stop"].is_set)


def _make_shard(job: _Job, raw: RawDataset, stopped: Callable[[], bool]) -> dict[str, Any]:
    """Make one shard, unless it is there unchanged, and return its entry of the manifest."""
    if job.known and find_fault(job.out, job.known, checksum=True) is None:
        return job.known
    arrays, distinct = _arrays(job, raw, stopped)
    names, labels = _names_and_labels(raw, job.objects)
    files = {}
    for kind, array in arrays.items():
        path = job.out / f"{job.name}.{kind}.npy"
        with _explaining_a_full_disk(job.out, array.nbytes), replacing(path) as file:
            np.save(file, array)
        files[kind] = {"name": path.name, "bytes": path.stat().st_size, "sha256": sha256(path)}
    shard = {"name": job.name, "names": names, "labels": labels, "distinct": distinct, "files": files}
    with _explaining_a_full_disk(job.out, 0):
        write_note(job.out, job.settings, shard)
    return shard


def _arrays(job: _Job, raw: RawDataset, stopped: Callable[[], bool]) -> tuple[dict[str, np.ndarray], int]:
    """Return `points [n, P, 3]` and, where they are wanted, `views [n, V, H, W]`; and the fewest distinct points of an object."""
    points, views, distinct = [], [], job.points
    for index in job.objects:
        if stopped():
            raise InterruptedError(f"{job.name}: stopped")
        stored, dense = _sample(raw.objects[index], job.points)
        points.append(stored)
        distinct = min(distinct, len(dense))
        if job.views is not None:
            views.append(render_views(dense, layout=job.views.layout, count=job.views.count, size=job.views.size))
    arrays = {"points": np.stack(points)}
    return (arrays | {"views": np.stack(views)} if views else arrays), distinct


def _sample(item: RawObject, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points to store `[count, 3]` and all points to render from, in one frame."""
    rng = np.random.default_rng(zlib.crc32(f"{item.split}/{item.name}".encode()))
    geometry = item.geometry()
    if isinstance(geometry, np.ndarray):
        dense = normalise(geometry, item.name)[0]
        order = np.arange(len(dense)) if item.shuffled or len(dense) == count else rng.permutation(len(dense))
        return dense[np.resize(order, count)], dense  # a cloud of fewer points begins anew: `distinct` in the manifest says so
    dense = object_points(dataclasses.replace(item, read=lambda: geometry), max(DENSE_POINTS, count), rng)
    return dense[:count], dense


def _names_and_labels(raw: RawDataset, objects: tuple[int, ...]) -> tuple[list[str], list[int]]:
    return [raw.objects[i].name for i in objects], [int(raw.objects[i].label) for i in objects]


def _check_space(out: Path, jobs: list[_Job]) -> None:
    """Refuse to start what cannot end."""
    needed = sum(sum(job.file_bytes().values()) for job in jobs if not job.known or find_fault(out, job.known, checksum=False))
    free = shutil.disk_usage(out).free
    if needed > free:
        raise OSError(errno.ENOSPC, f"{out}: {needed} bytes needed, {free} free")


@contextlib.contextmanager
def _explaining_a_full_disk(out: Path, needed: int) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        free = shutil.disk_usage(out).free
        raise OSError(errno.ENOSPC, f"{out}: the disk is full: {needed} bytes needed for the next file, {free} free") from error


@dataclass(frozen=True)
class _Command:
    """Prepare objects, or with `--verify` check a prepared folder. Continues where it stopped; repairs what has changed."""

    data: DataConfig = field(default_factory=DataConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
    out: Path | None = None
    """The folder to fill (default: data.prepared, else a folder of its settings under data/)."""
    workers: int | None = None
    """Processes (default: one per core)."""
    verify: bool = False
    """Only compare every file with its checksum; write nothing."""


def main(args: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 for bad input, 130 when interrupted."""
    command = tyro.cli(_Command, prog="python -m cmig_jax.data.prepare", args=args)
    any_model = ModelConfig(points=PointsConfig(k=1), keypoints=KeypointsConfig(select="all"))
    try:
        config = Config(data=command.data, views=command.views, model=any_model)
        out = command.out or (Path(command.data.prepared) if command.data.prepared else default_prepared_folder(config))
        if command.verify:
            objects = [len(Shards(out, split, verify="checksum")) for split in read_manifest(out)["splits"]]
            print(f"{out}: {sum(objects)} objects, every file is as it was written")
        else:
            print(prepare(config, out, workers=command.workers))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted: finished shards stay; the same command continues", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
