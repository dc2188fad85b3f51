"""Every method on the same test pairs: their errors, side by side (Sec. IV-B).

A pair is a dict of arrays, target = R source + t: `source` `[N, 3]`, `target` `[M, 3]`, `R` `[3, 3]`, `t` `[3]`; optionally `object`
`[P, 3]` (complete and clean, in the source's frame), `views` `[S, V, H, W]` uint8, `label`, `index`, `overlap` (the share of either
cloud that the other has too, where a data set knows it).
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import platform
import shutil
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray
from tqdm import tqdm

from cmig_jax.metrics import check_poses, closest_point_error, isotropic_errors, modified_chamfer, registration_metrics

Pair = Mapping[str, Any]
Method = Callable[[list[Pair]], tuple[ArrayLike, ArrayLike]]
Arrays = dict[str, NDArray[Any]]

RESULTS = "results.json"
ERRORS = "errors.npz"
METADATA = ("command", "config", "versions")
"""The keys of `results.json` that are not methods."""
PARTIAL = ".evaluation"
FORMAT = 2
"""Of the finished chunks: those of another format are computed anew."""
PACKAGES = ("cmig_jax", "jax", "flax", "numpy", "scipy", "small_gicp")


def evaluate(
    pairs: Iterable[Pair],
    methods: Mapping[str, Method],
    folder: Path,
    *,
    command: str,
    config: Mapping[str, Any],
    chunk: int = 16,
    progress: bool = True,
) -> dict[str, Any]:
    """Run every method on every pair and write `results.json` and `errors.npz` into a folder.

    Finished chunks are kept in the folder until all are done, so that a run that was interrupted continues. Each is found again by a
    digest of `config`, the method's name and the very arrays of its pairs: a change in any of these computes it anew.

    Args:
        pairs: the test pairs; read once, `chunk` at a time, so they may be made on the way.
        methods: by name; each takes a list of pairs and returns R `[n, 3, 3]` and t `[n, 3]`, `target_from_source`. One that registers
            pair by pair is made by `one_by_one`.
        folder: where the results go; created if it is missing.
        command: what was typed, for the record.
        config: what the results depend on, as JSON; a network's checkpoint belongs in it.
        chunk: pairs per call of a method; the last call may have fewer.
        progress: show a bar.

    Returns:
        What `results.json` holds: `{"<method>": {metric: value}}` with the entries of `registration_metrics`, `seconds_per_pair` (the
        median over chunks, after a chunk for warm-up) and `pairs`; beside the methods "command", "config" and "versions".
        `errors.npz` holds `index`, `label` (-1 for a pair without), `overlap` (NaN likewise), `R_true`, `t_true`, `angle_deg` (of
        R_true) and for each method `<method>/R`, `t`, `iso_r_deg`, `iso_t`, `closest_point`, `chamfer` (both NaN for a pair without
        `object`).

    Raises:
        ValueError: no pairs or methods, a method named like a reserved key, a pair without one of its arrays, a method's pose that is
            none: the method and the pair are named.
    """
    if not methods or set(methods) & set(METADATA) or chunk < 1:
        raise ValueError(
            f"methods {sorted(methods)}, chunk {chunk}: expected at least one of each, and no method named {', '.join(METADATA)}"
        )
    partial = folder / PARTIAL
    partial.mkdir(parents=True, exist_ok=True)
    settings = json.dumps([FORMAT, config, chunk], sort_keys=True)
    done: dict[str, list[Arrays]] = {name: [] for name in methods}
    truth: list[Arrays] = []
    warm: set[str] = set()
    with tqdm(total=len(pairs) if isinstance(pairs, Sized) else None, unit="pair", disable=not progress) as bar:
        for group in _chunks(pairs, chunk):
            truth.append(_truth(group, first=chunk * len(truth)))
            digest = _digest(settings, group)
            for name, method in methods.items():
                bar.set_description(name)
                path = partial / f"{hashlib.sha256(f'{name} {digest}'.encode()).hexdigest()[:32]}.npz"
                arrays = _load(path)
                if arrays is None:
                    arrays = _run(name, method, group, truth[-1], warm)
                    _write_arrays(path, arrays)
                done[name].append(arrays)
            bar.update(len(group))
    if not truth:
        raise ValueError("pairs: expected at least one, got none")
    results = _finish(folder, _concatenate(truth), {name: _concatenate(parts) for name, parts in done.items()}, command, config)
    shutil.rmtree(partial)
    return results


def one_by_one(register: Callable[[NDArray[Any], NDArray[Any]], tuple[ArrayLike, ArrayLike]]) -> Method:
    """Make a method of a function that registers one source `[N, 3]` to one target `[M, 3]`, such as a baseline."""

    def method(pairs: list[Pair]) -> tuple[ArrayLike, ArrayLike]:
        poses = [register(pair["source"], pair["target"]) for pair in pairs]
        return np.stack([np.asarray(R) for R, _ in poses]), np.stack([np.asarray(t) for _, t in poses])

    return method


def _chunks(pairs: Iterable[Pair], size: int) -> Iterator[list[Pair]]:
    pairs = iter(pairs)
    while group := list(itertools.islice(pairs, size)):
        yield group


def _truth(group: Sequence[Pair], first: int) -> Arrays:
    """Collect the true poses of a chunk; pairs without an index are counted from `first`."""
    for i, pair in enumerate(group):
        missing = [key for key in ("source", "target", "R", "t") if key not in pair]
        if missing:
            raise ValueError(f"pair {pair.get('index', first + i)}: {', '.join(missing)} missing, it holds {', '.join(pair)}")
    index = np.array([int(pair.get("index", first + i)) for i, pair in enumerate(group)])
    R_true, t_true = check_poses([pair["R"] for pair in group], [pair["t"] for pair in group], "true", names=index.tolist())
    return {
        "index": index,
        "label": np.array([int(pair.get("label", -1)) for pair in group]),
        "overlap": np.array([float(pair.get("overlap", np.nan)) for pair in group]),
        "R_true": R_true,
        "t_true": t_true,
        "angle_deg": isotropic_errors(np.broadcast_to(np.eye(3), R_true.shape), t_true, R_true, t_true)[0],
    }


def _digest(settings: str, group: Sequence[Pair]) -> str:
    digest = hashlib.sha256(settings.encode())
    for pair in group:
        for key in sorted(pair):
            array = np.ascontiguousarray(pair[key])
            digest.update(f"{key} {array.dtype} {array.shape}".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()


def _run(name: str, method: Method, group: list[Pair], truth: Arrays, warm: set[str]) -> Arrays:
    if name not in warm:  # compilation and first use of memory are not the method's time
        _poses(name, method, group, truth)
        warm.add(name)
    start = time.perf_counter()
    R, t = _poses(name, method, group, truth)
    seconds = (time.perf_counter() - start) / len(group)
    iso_r, iso_t = isotropic_errors(R, t, truth["R_true"], truth["t_true"])
    symmetric = [_up_to_symmetry(pair, R[i], t[i], truth["R_true"][i], truth["t_true"][i]) for i, pair in enumerate(group)]
    closest, chamfer = np.array(symmetric).T
    return {
        "R": R,
        "t": t,
        "iso_r_deg": iso_r,
        "iso_t": iso_t,
        "closest_point": closest,
        "chamfer": chamfer,
        "seconds": np.array([seconds]),
    }


def _up_to_symmetry(pair: Pair, R: ArrayLike, t: ArrayLike, R_true: ArrayLike, t_true: ArrayLike) -> tuple[float, float]:
    """Return the errors that need the complete object: closest point, Chamfer."""
    if "object" not in pair:
        return np.nan, np.nan
    return (
        closest_point_error(pair["object"], R, t, R_true, t_true),
        modified_chamfer(pair["source"], pair["target"], pair["object"], R, t, R_true, t_true),
    )


def _poses(name: str, method: Method, group: list[Pair], truth: Arrays) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    R, t = check_poses(*method(group), name, names=truth["index"].tolist())
    if len(R) != len(group):
        raise ValueError(f"{name}: {len(R)} poses for {len(group)} pairs")
    return R, t


def _finish(folder: Path, truth: Arrays, done: Mapping[str, Arrays], command: str, config: Mapping[str, Any]) -> dict[str, Any]:
    results: dict[str, Any] = {}
    errors = dict(truth)
    for name, found in done.items():
        whole = {key: None if np.isnan(found[key]).any() else found[key] for key in ("closest_point", "chamfer")}
        results[name] = registration_metrics(found["R"], found["t"], truth["R_true"], truth["t_true"], **whole)
        results[name] |= {"seconds_per_pair": float(np.median(found["seconds"])), "pairs": len(found["R"])}
        errors |= {f"{name}/{key}": array for key, array in found.items() if key != "seconds"}
    versions = {"python": platform.python_version()} | {package: version(package) for package in PACKAGES}
    results |= {"command": command, "config": dict(config), "versions": versions}
    _write_arrays(folder / ERRORS, errors)
    _write(folder / RESULTS, lambda file: file.write(f"{json.dumps(results, indent=2)}\n".encode()))
    return results


def _concatenate(parts: Sequence[Arrays]) -> Arrays:
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _load(path: Path) -> Arrays | None:
    """Read a finished chunk; one that a power cut left unreadable counts as not done."""
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            return {key: arrays[key] for key in arrays.files}
    except (OSError, EOFError, ValueError, zipfile.BadZipFile):
        return None


def _write_arrays(path: Path, arrays: Arrays) -> None:
    _write(path, lambda file: np.savez(file, **arrays))  # pyright: ignore[reportArgumentType]


def _write(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write under a temporary name, then rename: a file that is there is whole."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            write(file)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
