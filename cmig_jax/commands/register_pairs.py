"""`cmig register --pairs LIST.csv --out DIR`: many pairs, a row of `results.csv` for each, written as they finish."""

from __future__ import annotations

import csv
import functools
import hashlib
import io
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from cmig_jax.commands import Stopped
from cmig_jax.commands.register_inputs import Options, points_of, warn_of_units

MATRIX = tuple(f"m{row}{column}" for row in range(4) for column in range(4))
MEASURED = ("trusted", "why", "confidence", "overlap_source", "overlap_target", "inlier_rmse", "seconds", *MATRIX)
COLUMNS = ("name", "source", "target", *MEASURED, "error", "key")
"""Columns of `results.csv`. `m00` to `m33` are target_from_source, `key` says what a row was computed from."""
Row = dict[str, str]


@dataclass(frozen=True)
class ListedPair:
    """A row of the list: texts as they stand there, the files that they mean, and options of this pair."""

    name: str
    source: str
    target: str
    files: tuple[Path, Path]
    rotations: str


def run_pairs(listed: Path, out: Path, options: Options, quiet: bool) -> int:
    """Register the pairs of a list; return 2 if files of one could not be read, 1 if one is not trusted, otherwise 0.

    Rows of an earlier run are kept if settings and files are the same: sizes and times of change. Pairs with an error are tried again.

    Args:
        listed: CSV with the columns `source` and `target`, relative to its folder, and if wanted `name` and `rotations`.
        out: folder for `results.csv`; it is made.
        options: of every pair; `rotations` of a row comes before theirs.
        quiet: print nothing.

    Raises:
        ValueError: a list without these columns or rows, or a `results.csv` that is not of this command.
        Stopped: Ctrl-C.
    """
    from cmig_jax.files import write_text
    from cmig_jax.registration.threads import as_they_finish

    pairs = read_list(listed)
    keys = [_key(pair, options) for pair in pairs]
    out.mkdir(parents=True, exist_ok=True)
    results = out / "results.csv"
    known = _known(results)
    rows = [None if key is None or key not in known else known[key] | _named(pair) for key, pair in zip(keys, pairs, strict=True)]
    write_text(results, _text([row for row in rows if row is not None], header=True))
    left = [i for i, row in enumerate(rows) if row is None]
    try:
        with results.open("a", encoding="utf-8", newline="") as file:
            found = as_they_finish(functools.partial(_register, options=options), [pairs[i] for i in left])
            for i, row in tqdm(found, total=len(pairs), initial=len(pairs) - len(left), unit="pair", disable=quiet):
                rows[left[i]] = row | {"key": keys[left[i]] or ""}
                file.write(_text([rows[left[i]]]))
                file.flush()
    except KeyboardInterrupt:
        done = sum(row is not None for row in rows)
        raise Stopped(f"stopped after {done} of {len(pairs)} pairs; the same command continues") from None
    write_text(results, _text(rows, header=True))
    return _summary(rows, len(pairs) - len(left), results, quiet)


def read_list(path: Path) -> list[ListedPair]:
    """Read the pairs of a CSV file.

    Raises:
        ValueError: not CSV, no columns `source` and `target`, or no rows.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            header, *rows = [[cell.strip() for cell in row] for row in csv.reader(file) if any(cell.strip() for cell in row)] or [[]]
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not a readable CSV file ({error})") from error
    names = [name.lower() for name in header]
    if not {"source", "target"} <= set(names) or not rows:
        raise ValueError(f"{path}: columns {', '.join(header) or 'none'} and {len(rows)} rows; expected source, target and a row per pair")
    pairs = []
    for number, row in enumerate(rows, 1):
        cells = dict(zip(names, row, strict=False))
        source, target = cells.get("source", ""), cells.get("target", "")
        files = (path.parent / source, path.parent / target)
        pairs.append(ListedPair(cells.get("name") or str(number), source, target, files, cells.get("rotations", "")))
    return pairs


def _register(pair: ListedPair, options: Options) -> Row:
    """Return the row of a pair, with the error of files that cannot be read or registered."""
    from cmig_jax.data.geometry_files import read_geometry
    from cmig_jax.registration.register import register

    begin = time.perf_counter()
    try:
        rotations = _rotations(pair.rotations) if pair.rotations else options.rotations
        files = [read_geometry(path, options.invalid) for path in pair.files]
        warn_of_units(*files)
        source, target = (points_of(file.geometry, seed) for seed, file in enumerate(files))
        found = register(source, target, options.network, rotations=rotations, up=options.up, refine=options.refine)
    except (ValueError, OSError) as error:
        return _row(pair, error=" ".join(str(error).split()))
    values = (found.trusted, found.why, found.confidence, *found.overlap, found.inlier_rmse, time.perf_counter() - begin)
    return _row(pair, **dict(zip(MEASURED, (*values, *found.matrix.ravel().tolist()), strict=True)))


def _rotations(text: str) -> Literal["any", "yaw"] | float:
    if text == "any" or text == "yaw":
        return text
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"rotations {text!r}; expected any, yaw, or an angle in degrees") from None


def _named(pair: ListedPair) -> Row:
    return {"name": pair.name, "source": pair.source, "target": pair.target}


def _row(pair: ListedPair, **values: Any) -> Row:
    texts = {name: f"{value:.10g}" if isinstance(value, float) and name not in MATRIX else str(value) for name, value in values.items()}
    return dict.fromkeys(COLUMNS, "") | _named(pair) | texts


def _key(pair: ListedPair, options: Options) -> str | None:
    """Return what a row depends on as a short text, or None where a file does not exist."""
    try:
        stats = [path.stat() for path in pair.files]
    except OSError:
        return None
    files = [[str(path.resolve()), stat.st_size, stat.st_mtime_ns] for path, stat in zip(pair.files, stats, strict=True)]
    settings = [pair.rotations or str(options.rotations), options.up, options.refine, options.invalid, options.network_key]
    return hashlib.sha256(json.dumps([files, settings]).encode()).hexdigest()[:16]


def _known(results: Path) -> dict[str, Row]:
    """Return the complete rows without an error of an earlier run, by key.

    Raises:
        ValueError: a file with other columns.
    """
    if not results.exists():
        return {}
    text = results.read_text(encoding="utf-8", errors="replace")
    complete = text[: text.rfind("\n") + 1]  # a killed run may leave a part of a line
    header, *rows = list(csv.reader(io.StringIO(complete))) or [[]]
    if tuple(header) != COLUMNS:
        raise ValueError(f"{results}: not a file of this command; expected another folder as --out")
    named = [dict(zip(COLUMNS, row, strict=True)) for row in rows if len(row) == len(COLUMNS)]
    return {row["key"]: row for row in named if row["key"] and not row["error"]}


def _text(rows: Sequence[Row | None], header: bool = False) -> str:
    written = io.StringIO()
    writer = csv.DictWriter(written, COLUMNS, lineterminator="\n")
    if header:
        writer.writeheader()
    writer.writerows(row for row in rows if row is not None)
    return written.getvalue()


def _summary(rows: Sequence[Row | None], before: int, results: Path, quiet: bool) -> int:
    bad = [row for row in rows if row is not None and row["error"]]
    trusted = sum(row is not None and row["trusted"] == "True" for row in rows)
    if not quiet:
        for row in bad:
            print(f"{row['name']}: {row['error']}")
        took = [float(row["seconds"]) for row in rows if row is not None and row["seconds"]]
        median = f", {np.median(took):.2g} s each" if took else ""
        print(f"{len(rows)} pairs: {trusted} trusted, {len(rows) - trusted - len(bad)} not, {len(bad)} with an error{median}")
        print(f"{results}{f'; {before} were there before' if before else ''}")
    return 2 if bad else int(trusted < len(rows))
