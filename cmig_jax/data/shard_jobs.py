"""The work of a preparation: one shard at a time, in this process or in a pool of worker processes."""

from __future__ import annotations

import concurrent.futures
import contextlib
import errno
import multiprocessing
import os
import pickle
import shutil
import signal
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.context import SpawnContext
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cmig_jax.config import ViewsConfig
from cmig_jax.data.normals import observed_normals
from cmig_jax.data.raw import RawDataset, RawObject
from cmig_jax.data.render import render_views
from cmig_jax.data.sample import normalise, sample_surface_and_normals
from cmig_jax.data.shards import find_fault, write_note
from cmig_jax.files import replacing, sha256

DENSE_POINTS = 16384
"""Points that a mesh is rendered from."""


@dataclass(frozen=True)
class Job:
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
        vectors = len(self.objects) * self.points * 3 * 4
        sizes = {"points": vectors, "normals": vectors}
        if self.views is not None:
            sizes["views"] = len(self.objects) * self.views.count * self.views.size**2
        return sizes


def run_here(jobs: list[Job], raw: RawDataset, bar: tqdm) -> list[dict[str, Any]]:
    """Run the jobs in this process, and return their entries of the manifest."""
    made = []
    for job in jobs:
        made.append(_make_shard(job, raw, lambda: False))
        bar.update(len(job.objects))
    return made


def run_in_workers(jobs: list[Job], raw: RawDataset, workers: int, bar: tqdm) -> list[dict[str, Any]]:
    """Run the jobs in new processes; on an error or Ctrl-C these stop after the object that they work on.

    Raises:
        ValueError: objects that cannot be pickled.
        OSError: a worker ended early.
    """
    _check_picklable(raw)
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    with tempfile.TemporaryDirectory() as folder, _pool(workers, context, raw, Path(folder), stop) as pool:
        try:
            with _interrupts_blocked():
                futures = [pool.submit(_make_in_worker, job) for job in jobs]
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


def _pool(workers: int, context: SpawnContext, raw: RawDataset, folder: Path, stop: Any) -> concurrent.futures.ProcessPoolExecutor:
    """Make the pool; its processes read the objects from a file.

    As an argument of theirs, more than a pipe holds would block this process for ever if one of them ends while it starts.
    """
    path = folder / "objects.pickle"
    path.write_bytes(pickle.dumps(raw))
    return concurrent.futures.ProcessPoolExecutor(workers, context, _start_worker, (path, stop))


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Start worker processes with Ctrl-C blocked: a terminal sends it to all processes, and this process stops the workers."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    blocked_before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked_before)


def _check_picklable(raw: RawDataset) -> None:
    """Raise ValueError for objects that cannot be sent to other processes; the pool itself would fail without naming one."""
    for item in raw.objects:
        try:
            pickle.dumps(item)
        except Exception as error:  # what pickle raises depends on the object
            fault = f"its `read` cannot be sent to worker processes ({error})"
            raise ValueError(f"{item.name}: {fault}; expected a module-level function or a partial of one, or workers=1") from error


_worker: dict[str, Any] = {}


def _start_worker(objects: Path, stop: Any) -> None:
    threading.Thread(target=_end_with_the_parent, daemon=True).start()
    _worker.update(raw=pickle.loads(objects.read_bytes()), stop=stop)


def _end_with_the_parent() -> None:
    """End this process when its parent ends; without this, the workers of a killed process would wait forever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make_in_worker(job: Job) -> dict[str, Any]:
    return _make_shard(job, _worker["raw"], _worker["stop"].is_set)


def _make_shard(job: Job, raw: RawDataset, stopped: Callable[[], bool]) -> dict[str, Any]:
    """Make one shard, unless the known one is unchanged, and return its entry of the manifest."""
    if job.known and find_fault(job.out, job.known, checksum=True) is None:
        return job.known
    arrays, distinct = _arrays(job, raw, stopped)
    names, labels = names_and_labels(raw, job.objects)
    files = {}
    for kind, array in arrays.items():
        path = job.out / f"{job.name}.{kind}.npy"
        with explaining_a_full_disk(job.out, array.nbytes), replacing(path) as file:
            np.save(file, array)
        files[kind] = {"name": path.name, "bytes": path.stat().st_size, "sha256": sha256(path)}
    shard = {"name": job.name, "names": names, "labels": labels, "distinct": distinct, "files": files}
    with explaining_a_full_disk(job.out, 0):
        write_note(job.out, job.settings, shard)
    return shard


def _arrays(job: Job, raw: RawDataset, stopped: Callable[[], bool]) -> tuple[dict[str, np.ndarray], list[int]]:
    """Return `points` and `normals [n, P, 3]`, `views [n, V, H, W]` if the job asks for them; and the distinct points of each object."""
    points, normals, views, distinct = [], [], [], []
    for index in job.objects:
        if stopped():
            raise InterruptedError(f"{job.name}: stopped")
        stored, turned, dense = _sample(raw.objects[index], job.points)
        points.append(stored)
        normals.append(turned)
        distinct.append(min(job.points, len(dense)))
        if job.views is not None:
            views.append(render_views(dense, layout=job.views.layout, count=job.views.count, size=job.views.size))
    arrays = {"points": np.stack(points), "normals": np.stack(normals)}
    return (arrays | {"views": np.stack(views)} if views else arrays), distinct


def _sample(item: RawObject, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points to store `[count, 3]`, in random order, with their normals, and all points to render from, in the same frame."""
    rng = np.random.default_rng(zlib.crc32(f"{item.split}/{item.name}".encode()))
    geometry, normals = item.geometry_and_normals()
    if isinstance(geometry, np.ndarray):
        dense = normalise(geometry, item.name)
        order = np.arange(len(dense)) if item.shuffled else rng.permutation(len(dense))
        chosen = np.resize(order, count)  # a smaller cloud repeats its points; the manifest says how many are distinct
        return dense[chosen], observed_normals(dense, dense[chosen]) if normals is None else normals[chosen], dense
    drawn, normals = sample_surface_and_normals(geometry, max(DENSE_POINTS, count), rng)
    dense = normalise(drawn, item.name)
    return dense[:count], normals[:count], dense


def names_and_labels(raw: RawDataset, objects: tuple[int, ...]) -> tuple[list[str], list[int]]:
    """Return names and labels of the objects with these numbers."""
    return [raw.objects[i].name for i in objects], [int(raw.objects[i].label) for i in objects]


@contextlib.contextmanager
def explaining_a_full_disk(out: Path, needed: int) -> Iterator[None]:
    """Add the folder, the bytes needed and the bytes free to the error of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        free = shutil.disk_usage(out).free
        raise OSError(errno.ENOSPC, f"{out}: the disk is full: {needed} bytes needed for the next file, {free} free") from error
