"""Every method on the same test pairs: their errors, side by side (Sec. IV-B).

A pair is a dict of arrays, target = R source + t: `source` `[N, 3]`, `target` `[M, 3]`, `R` `[3, 3]`, `t` `[3]`; optionally `object`
`[P, 3]` (complete and clean, in the source's frame), `views` `[S, V, H, W]` uint8, `label`, `index`, and `overlap`, where a data set
knows it from denser clouds (`data.overlap`).
"""

from __future__ import annotations

import hashlib
import itertools
import json
import platform
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cmig_jax.data.overlap import overlap
from cmig_jax.evaluation.metrics import closest_point_error, isotropic_errors, modified_chamfer, registration_metrics
from cmig_jax.files import DAMAGED, replacing, write_text
from cmig_jax.transform import RigidTransform, check_transform, stack

Pair = Mapping[str, Any]
Method = Callable[[list[Pair]], RigidTransform]
Arrays = dict[str, NDArray[Any]]

RESULTS = "results.json"
ERRORS = "errors.npz"
METADATA = ("command", "config", "versions")
"""The keys of `results.json` that are not methods."""
PARTIAL = ".evaluation"
FORMAT = 3
"""Format of the stored chunks; chunks of another format are computed again."""
MATCH_DISTANCE = 0.05
"""A point overlaps, and a correspondence is right, if it lies within this of the other cloud, or its correspondent, under the true pose."""
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

    Each chunk of pairs is stored in the folder until all are done, so that an interrupted run continues. It is identified by a digest
    of `config`, the method's name and the arrays of its pairs: a change in any of these computes it again.

    Args:
        pairs: the test pairs; read once, `chunk` at a time, so they may be generated lazily.
        methods: by name; each takes a list of n pairs and returns target_from_source `[n]`. `one_by_one` makes one that registers pair
            by pair.
        folder: where the results go; created if it is missing.
        command: what was typed, for the record.
        config: what the results depend on, as JSON; a network's checkpoint belongs in it.
        chunk: pairs per call of a method; the last call may have fewer.
        progress: show a bar.

    Returns:
        What `results.json` holds: `{"<method>": {metric: value}}` with the entries of `registration_metrics`, `seconds_per_pair` (the
        median over chunks, after a chunk for warm-up) and `pairs`; beside the methods "command", "config" and "versions".
        `errors.npz` holds `index`, `label` (-1 for a pair without), `overlap` (the data set's, or measured on the clouds within
        `MATCH_DISTANCE`), `R_true`, `t_true`, `angle_deg` (of R_true), and for each method `<method>/R`, `t`, `iso_r_deg`, `iso_t`,
        `closest_point` and `chamfer` (both NaN for a pair without `object`).

    Raises:
        ValueError: no pairs or methods, a method named like a reserved key, a pair without one of its arrays, a method's pose
            that is not valid: the method is named.
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
    results = _write_results(folder, _concatenate(truth), {name: _concatenate(parts) for name, parts in done.items()}, command, config)
    shutil.rmtree(partial)
    return results


def one_by_one(register: Callable[[NDArray[Any], NDArray[Any]], RigidTransform]) -> Method:
    """Make a method of a function that registers one source `[N, 3]` to one target `[M, 3]`, such as a baseline."""
    return lambda pairs: stack([register(pair["source"], pair["target"]) for pair in pairs])


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
    true = stack([check_transform(pair["R"], pair["t"], f"true pose of pair {n}") for n, pair in zip(index, group, strict=True)])
    return {
        "index": index,
        "label": np.array([int(pair.get("label", -1)) for pair in group]),
        "overlap": np.array([_overlap(pair) for pair in group]),
        "R_true": true.R,
        "t_true": true.t,
        "angle_deg": np.degrees(true.angle()),
    }


def _overlap(pair: Pair) -> float:
    known = pair.get("overlap")
    return overlap(pair["source"], pair["target"], pair["R"], pair["t"], MATCH_DISTANCE) if known is None else float(known)


def _digest(settings: str, group: Sequence[Pair]) -> str:
    digest = hashlib.sha256(settings.encode())
    for pair in group:
        for key in sorted(pair):
            array = np.ascontiguousarray(pair[key])
            digest.update(f"{key} {array.dtype} {array.shape}".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()


def _run(name: str, method: Method, group: list[Pair], truth: Arrays, warm: set[str]) -> Arrays:
    if name not in warm:  # compilation and first use of memory do not count as the method's time
        _poses(name, method, group, truth)
        warm.add(name)
    start = time.perf_counter()
    estimated = _poses(name, method, group, truth)
    seconds = (time.perf_counter() - start) / len(group)
    true = RigidTransform(R=truth["R_true"], t=truth["t_true"])
    iso_r, iso_t = isotropic_errors(estimated, true)
    closest, chamfer = np.array([_up_to_symmetry(pair, estimated[i], true[i]) for i, pair in enumerate(group)]).T
    arrays = {"R": estimated.R, "t": estimated.t, "iso_r_deg": iso_r, "iso_t": iso_t, "closest_point": closest, "chamfer": chamfer}
    return arrays | {"seconds": np.array([seconds])}


def _up_to_symmetry(pair: Pair, estimated: RigidTransform, true: RigidTransform) -> tuple[float, float]:
    """Return the errors that need the complete object: closest point, Chamfer."""
    if "object" not in pair:
        return np.nan, np.nan
    clouds = pair["source"], pair["target"], pair["object"]
    return closest_point_error(pair["object"], estimated, true), modified_chamfer(*clouds, estimated, true)


def _poses(name: str, method: Method, group: list[Pair], truth: Arrays) -> RigidTransform:
    found = method(group)
    if found.t.shape != (len(group), 3):
        raise ValueError(f"{name}: translations of shape {found.t.shape} for {len(group)} pairs; expected [{len(group)}, 3]")
    return stack([check_transform(found.R[i], found.t[i], f"{name}, pair {index}") for i, index in enumerate(truth["index"])])


def _write_results(folder: Path, truth: Arrays, done: Mapping[str, Arrays], command: str, config: Mapping[str, Any]) -> dict[str, Any]:
    results: dict[str, Any] = {}
    errors = dict(truth)
    for name, found in done.items():
        whole = {key: None if np.isnan(found[key]).any() else found[key] for key in ("closest_point", "chamfer")}
        estimated, true = RigidTransform(R=found["R"], t=found["t"]), RigidTransform(R=truth["R_true"], t=truth["t_true"])
        results[name] = registration_metrics(estimated, true, **whole)
        results[name] |= {"seconds_per_pair": float(np.median(found["seconds"])), "pairs": len(found["R"])}
        errors |= {f"{name}/{key}": array for key, array in found.items() if key != "seconds"}
    versions = {"python": platform.python_version()} | {package: version(package) for package in PACKAGES}
    results |= {"command": command, "config": dict(config), "versions": versions}
    _write_arrays(folder / ERRORS, errors)
    write_text(folder / RESULTS, f"{json.dumps(results, indent=2)}\n")
    return results


def _concatenate(parts: Sequence[Arrays]) -> Arrays:
    return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}


def _load(path: Path) -> Arrays | None:
    """Read a stored chunk; one that a power cut left unreadable counts as not done."""
    try:
        with path.open("rb") as file, np.load(file) as arrays:
            return {key: arrays[key] for key in arrays.files}
    except DAMAGED:
        return None


def _write_arrays(path: Path, arrays: Arrays) -> None:
    with replacing(path) as file:
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
