"""The rows of a comparison: differences, the bounds that they are held to, and their table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cmig_jax.files import write_text
from cmig_jax.parity.cases import State, as_recorded

Dtype = Literal["float64", "float32"]

OUTPUT_BOUND = 1e-8  # float64: features, losses, poses
STATE_BOUND = 1e-6  # float64: gradients, running statistics, parameters
STAGE_BOUND = 1e-4  # float32: a stage that reads the reference's values
STATES = ("grad_norm", "gradient", "buffer_sum", "statistics", "adam")
# A gradient below this share of the largest is rounding: a bias before a norm or a softmax has none. Its difference is taken relative
# to a share of the largest one instead of to itself.
NO_GRADIENT = 1e-7
ROUNDING = {"float64": 1e-7, "float32": 1e-2}


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        key: what was compared.
        absolute: largest absolute difference.
        relative: largest difference, relative to the reference's largest value or to each of its elements.
        bound: of the relative difference.
        note: what else there is to say.
        tie: the difference comes from a choice between values that are equal up to rounding; `note` says which.
    """

    key: str
    absolute: float
    relative: float
    bound: float
    note: str = ""
    tie: bool = False

    @property
    def holds(self) -> bool:
        """Whether the difference is a number within its bound, or comes from a tie."""
        return self.tie or self.relative <= self.bound


def compare(key: str, ours: NDArray | None, reference: NDArray, bound: float, floor: float = 0.0, elementwise: bool = False) -> Row:
    """Compare two arrays.

    Args:
        key: what they are.
        ours, reference: of equal shape; other shapes fail, and so does None.
        bound: of the relative difference.
        floor: magnitude that a smaller reference is taken to have.
        elementwise: relative to each element of the reference instead of its largest.
    """
    if ours is None or ours.shape != reference.shape:
        note = "not computed" if ours is None else f"shape {ours.shape}, recorded {reference.shape}"
        return Row(key, math.nan, math.nan, bound, note)
    difference, magnitude = np.abs(ours.astype(np.float64) - reference), np.abs(np.asarray(reference, np.float64))
    scale = np.maximum(magnitude if elementwise else magnitude.max(initial=0.0), max(floor, np.finfo(np.float32).tiny))
    return Row(key, float(difference.max(initial=0.0)), float((difference / scale).max(initial=0.0)), bound)


def compare_all(reference: State, run: State, dtype: Dtype) -> list[Row]:
    """Compare the results of a run with the recorded ones, by name: one row for each (see `cases` for the names)."""
    gradients = [np.abs(value).max() for key, value in reference.items() if key.startswith(("grad_norm/", "gradient/"))]
    largest, rows = float(max(gradients, default=0.0)), []
    for key, expected in reference.items():
        kind, _, name = key.partition("/")
        floor = 0.0
        if kind in ("grad_norm", "gradient") and np.abs(expected).max() < NO_GRADIENT * largest:
            floor = ROUNDING[dtype] * largest
        elif kind == "buffer_sum" and dtype == "float32" and f"statistics/{name}" in run:  # a sum that cancels keeps its terms' rounding
            floor = float(np.abs(run[f"statistics/{name}"]).sum())
        bound = STAGE_BOUND if dtype == "float32" else STATE_BOUND if kind in STATES else OUTPUT_BOUND
        elementwise = kind == "loss_terms" or (key.endswith("/stats") and dtype == "float64")
        rows.append(compare(key, as_recorded(key, run), expected, bound, floor, elementwise))
    return rows


def used(row: Row) -> float:
    """Return the share of its bound that a row uses: infinite if it is not a number, -1 for a tie."""
    return -1.0 if row.tie else math.inf if math.isnan(row.relative) else row.relative / row.bound


def table(rows: Sequence[Row]) -> str:
    """Write rows as a table."""
    width = max((len(row.key) for row in rows), default=0)
    lines = [f"{'':{width}}  {'absolute':>9}  {'relative':>9}  {'bound':>7}"]
    for row in rows:
        verdict = "TIE" if row.tie else "" if row.holds else "FAILS"
        lines.append(f"{row.key:{width}}  {row.absolute:9.1e}  {row.relative:9.1e}  {row.bound:7.0e}  {verdict}  {row.note}".rstrip())
    return "\n".join(lines)


def summary(rows: Sequence[Row], group_of: Callable[[str], str]) -> str:
    """Write one line per group of rows, by their keys: how many there are, and the one that uses most of its bound."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(group_of(row.key), []).append(row)
    lines = []
    for name, members in groups.items():
        failing, ties, worst = sum(not row.holds for row in members), sum(row.tie for row in members), max(members, key=used)
        verdict = (f"{failing} FAIL" if failing else "all hold") + (f", {ties} by a TIE" if ties else "")
        lines.append(f"{name:10}  {len(members):4} rows, {verdict}; largest relative difference {worst.relative:.1e} ({worst.key})")
    return "\n".join(lines)


def write_json(path: Path, header: Mapping[str, Any], rows: Sequence[Row]) -> None:
    """Write rows as JSON: `header`, `holds`, and `rows` with what a `Row` has; a difference that is no number is null."""
    numbers = [{name: value if math.isfinite(value := getattr(row, name)) else None for name in ("absolute", "relative")} for row in rows]
    listed = [vars(row) | finite | {"holds": row.holds} for row, finite in zip(rows, numbers, strict=True)]
    write_text(path, json.dumps({**header, "holds": all(row.holds for row in rows), "rows": listed}, indent=1) + "\n")
