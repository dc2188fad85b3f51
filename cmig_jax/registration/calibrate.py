"""`python -m cmig_jax.registration.calibrate --out FOLDER [--data DIR]`: fit the weights of the verdict, and say what it is worth."""

from __future__ import annotations

import json
import multiprocessing
import signal
import sys
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray
from scipy.optimize import minimize
from tqdm import tqdm

from cmig_jax.config import DataConfig
from cmig_jax.data.raw import RawObject
from cmig_jax.data.sources import open_objects
from cmig_jax.files import write_text
from cmig_jax.registration import search, verdict
from cmig_jax.registration.clouds import user_cloud
from cmig_jax.registration.drawn import Drawn, draw
from cmig_jax.registration.evidence import DISTANCES
from cmig_jax.registration.frame import Frame
from cmig_jax.registration.register import LEVELS
from cmig_jax.transform import RigidTransform

Floats = NDArray[np.float64]
Job = tuple[list[RawObject], int, int]
"""Objects, seed and number of a pair."""
MOST_ANGLE_DEG, MOST_SHIFT = 5.0, 0.05
"""A pose is right within these."""
CHOICE = ("cost", "cut", *(f"distance_{low:g}" for low, _ in DISTANCES), "starts", "turn")
RIDGE = 0.003
BINS = 10


@dataclass(frozen=True)
class Command:
    """Draw pairs of training objects, search their poses, fit the verdict on most objects and measure it on the others."""

    out: Path
    """Folder for the pairs; those that are there are not searched again."""
    data: Path | None = None
    """Folder of ModelNet40's HDF5 release: half of the pairs are of its training objects, the others of generated ones."""
    pairs: int = 2_400
    """Number of pairs."""
    held_out: float = 0.3
    """Share of the objects to measure on."""
    seed: int = 0
    """Seed of the pairs."""
    workers: int = 2
    """Processes; with 1, this one does the work."""
    weights: Path | None = None
    """File for the weights, which otherwise are printed only; the package reads its own `verdict.json`."""


def main(command: Command) -> int:
    """Draw and search what is missing, fit, print, and write.

    Raises:
        ValueError: a folder without the data.
    """
    command.out.mkdir(parents=True, exist_ok=True)
    objects = [_objects(DataConfig(source="shapes", shapes=40, categories="first-half"))]
    if command.data is not None:
        objects.append(_objects(DataConfig(source="modelnet40-hdf5", root=str(command.data))))
    rows = _searched(command, objects)
    held = np.array([_share(row["object"]) < command.held_out for row in rows])
    fitted = {"choice": fit_choice([row for row, out in zip(rows, held, strict=True) if not out])}
    fitted["confidence"] = fit_confidence([best_of(row, fitted) for row, out in zip(rows, held, strict=True) if not out])
    for name, part in (("fitted on", ~held), ("held out", held)):
        print("\n".join(report(name, [best_of(row, fitted) for row, inside in zip(rows, part, strict=True) if inside])))
    if command.weights is not None:
        write_text(command.weights, json.dumps(fitted, indent=1) + "\n")
    return 0


def _objects(data: DataConfig) -> list[RawObject]:
    return [item for item in open_objects(data).objects if item.split == "train"]


def _share(name: str) -> float:
    """Return a number in [0, 1) that depends on an object's name alone."""
    return zlib.crc32(f"held out: {name}".encode()) / 2**32


def _searched(command: Command, objects: Sequence[list[RawObject]]) -> list[dict[str, Any]]:
    """Return the rows of all pairs, one line of a file each; a line that was cut short is searched again."""
    path = command.out / f"pairs-{command.seed}.jsonl"
    rows = []
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                rows.append(json.loads(line))
            except ValueError:
                break
        rows = rows[: command.pairs]
        write_text(path, "".join(f"{json.dumps(row)}\n" for row in rows))
    jobs = [(objects[i % len(objects)], command.seed, i) for i in range(len(rows), command.pairs)]
    with path.open("a", encoding="utf-8") as file:
        for row in tqdm(_made(jobs, command.workers), initial=len(rows), total=command.pairs, unit="pair", file=sys.stderr):
            file.write(f"{json.dumps(row)}\n")
            file.flush()
            rows.append(row)
    return rows


def _made(jobs: Sequence[Job], workers: int) -> Iterator[dict[str, Any]]:
    if workers == 1:
        yield from map(_row, jobs)
        return
    with multiprocessing.get_context("spawn").Pool(workers, signal.signal, (signal.SIGINT, signal.SIG_IGN)) as pool:  # Ctrl-C ends this one
        yield from pool.imap(_row, jobs)


def _row(job: Job) -> dict[str, Any]:
    objects, seed, number = job
    rng = np.random.default_rng([seed, number])
    position = int(rng.integers(len(objects)))
    pair = draw(objects, position, rng)
    return {"object": objects[position].name, "kind": pair.kind, "candidates": _candidates(pair)}


def _candidates(pair: Drawn) -> list[dict[str, Any]]:
    frame = Frame(user_cloud(pair.source, "source"), user_cloud(pair.target, "target"))
    _, fine, coarse = frame.levels(LEVELS)
    limit = 180.0 if pair.rotations == "any" else float(pair.rotations)
    candidates = search.find(coarse, fine, search.starts(limit), limit)
    numbers = verdict.numbers_of(*fine, candidates, limit)
    return [
        {"right": pair.kind == "same" and is_right(frame.original(candidate.matrix), pair.pose), "numbers": found}
        for candidate, found in zip(candidates, numbers, strict=False)
    ]


def is_right(found: RigidTransform, true: RigidTransform) -> bool:
    """Say whether a pose of an object of radius 1 is within 5 degrees and 0.05."""
    return bool(np.degrees(found.compose(true.inverse()).angle()) < MOST_ANGLE_DEG and np.linalg.norm(found.t - true.t) < MOST_SHIFT)


def fit_choice(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Fit a conditional logistic model: the probability that a candidate is right, given that one is."""
    _, scale = _scales([each["numbers"] for row in rows for each in row["candidates"]], CHOICE)
    groups = []
    for row in rows:
        right = np.array([each["right"] for each in row["candidates"]])
        if right.any() and not right.all():
            groups.append((_table([each["numbers"] for each in row["candidates"]], CHOICE) / scale, right))
    if not groups:
        raise ValueError(f"{len(rows)} pairs, none with a right candidate and a wrong one: expected more pairs")

    def loss(w: Floats) -> tuple[float, Floats]:
        total, slope = 0.0, np.zeros_like(w)
        for X, right in groups:
            shares = np.exp(X @ w - (X @ w).max())
            among = np.where(right, shares, 0)
            total -= np.log(among.sum() / shares.sum())
            slope -= X.T @ (among / among.sum() - shares / shares.sum())
        return float(total / len(groups) + RIDGE * w @ w), slope / len(groups) + 2 * RIDGE * w

    w = minimize(loss, np.zeros(len(CHOICE)), jac=True, method="L-BFGS-B").x
    return dict(zip(CHOICE, (w / scale).tolist(), strict=True))


@dataclass(frozen=True)
class Best:
    """The best pose of a pair: its numbers with those of the choice, whether it is right, and the pair's kind."""

    numbers: dict[str, float]
    right: bool
    found: bool
    kind: str
    confidence: float = 0.0


def best_of(row: dict[str, Any], weights: dict[str, dict[str, float]]) -> Best:
    """Return the best candidate of a pair under weights, with its confidence if they have one."""
    scores = np.array([verdict.weighted_sum(weights["choice"], each["numbers"]) for each in row["candidates"]])
    best = row["candidates"][int(np.argmax(scores))]
    share = float(-np.log(np.exp(scores - scores.max()).sum()))
    numbers = {**best["numbers"], "probability": share, "one": 1.0}
    known = weights.get("confidence")
    confidence = 0.0 if known is None else float(1 / (1 + np.exp(-verdict.weighted_sum(known, numbers))))
    return Best(numbers, best["right"], any(each["right"] for each in row["candidates"]), row["kind"], confidence)


def fit_confidence(best: Sequence[Best]) -> dict[str, float]:
    """Fit a logistic model of whether the best pose is right."""
    names = tuple(name for name in best[0].numbers if name != "one")
    mean, scale = _scales([each.numbers for each in best], names)
    X = np.c_[(_table([each.numbers for each in best], names) - mean) / scale, np.ones(len(best))]
    sign = np.where([each.right for each in best], 1.0, -1.0)

    def loss(w: Floats) -> tuple[float, Floats]:
        margin = sign * (X @ w)
        penalty = np.append(RIDGE * w[:-1], 0.0)
        return float(np.logaddexp(0, -margin).mean() + penalty @ w), -(sign / (1 + np.exp(margin))) @ X / len(X) + 2 * penalty

    w = minimize(loss, np.zeros(X.shape[1]), jac=True, method="L-BFGS-B").x
    return {**dict(zip(names, (w[:-1] / scale).tolist(), strict=True)), "one": float(w[-1] - w[:-1] @ (mean / scale))}


def report(name: str, best: Sequence[Best]) -> list[str]:
    """Say how often the best pose is right, and what the confidence is worth, at several thresholds."""
    right, sure, kind = (np.array([getattr(each, field) for each in best]) for field in ("right", "confidence", "kind"))
    same = kind == "same"
    found = np.mean([each.found for each in best if each.kind == "same"])
    cell = np.minimum((sure * BINS).astype(int), BINS - 1)
    error = sum(np.mean(cell == i) * abs(sure[cell == i].mean() - right[cell == i].mean()) for i in np.unique(cell))
    lines = [
        f"{name}: {len(best)} pairs, {same.sum()} of one object: right {right[same].mean():.1%}, right among the candidates {found:.1%}; "
        f"calibration error {error:.3f}"
    ]
    for threshold in (0.4, 0.5, 0.6, 0.7):
        doubted = sure < threshold
        shares = {"wrong": ~right, "wrong, same object": same & ~right, "right": right} | {
            k: kind == k for k in ("other", "mirrored", "scaled")
        }
        told = ", ".join(f"{what} {doubted[which].mean():.1%} of {which.sum()}" for what, which in shares.items() if which.any())
        lines.append(f"  not trusted below {threshold}: {told}")
    return lines


def _table(numbers: Sequence[dict[str, float]], names: Sequence[str]) -> Floats:
    return np.array([[each[name] for name in names] for each in numbers])


def _scales(numbers: Sequence[dict[str, float]], names: Sequence[str]) -> tuple[Floats, Floats]:
    table = _table(numbers, names)
    return table.mean(axis=0), table.std(axis=0) + 1e-9


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command)))
