"""The rows of a comparison: differences, the bounds they are held to, and their table."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmig_jax.training.checkpoint import write_atomically

OUTPUT_BOUND = 1e-8  # float64: features, losses, poses
STATE_BOUND = 1e-6  # float64: gradients, running statistics, parameters
STAGE_BOUND = 1e-4  # float32: a stage fed the reference's input


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        key: what was compared.
        absolute: largest absolute difference.
        relative: largest difference, relative to the reference's largest value or to each of its elements.
        bound: of the relative difference; None where it is only shown.
        note: what else there is to say.
    """

    key: str
    absolute: float
    relative: float
    bound: float | None
    note: str = ""

    @property
    def holds(self) -> bool:
        """Whether the difference is a number within its bound."""
        return self.bound is None or self.relative <= self.bound


def compare(key: str, ours: NDArray | None, reference: NDArray, bound: float | None, floor: float = 0.0, elementwise: bool = False) -> Row:
    """Compare two arrays.

    Args:
        key: what they are.
        ours, reference: of equal shape.
        bound: of the relative difference.
        floor: magnitude below which the reference counts as this large.
        elementwise: relative to each element of the reference instead of its largest.
    """
    if ours is None:
        return Row(key, math.nan, math.nan, bound, "not computed")
    if ours.shape != reference.shape:
        return Row(key, math.nan, math.nan, bound, f"shape {ours.shape}, recorded {reference.shape}")
    difference = np.abs(ours.astype(np.float64) - reference)
    magnitude = np.abs(np.asarray(reference, np.float64))
    if not elementwise:
        magnitude = magnitude.max(initial=0.0)
    scale = np.maximum(np.maximum(magnitude, floor), np.finfo(np.float32).tiny)
    return Row(key, float(difference.max(initial=0.0)), float((difference / scale).max(initial=0.0)), bound)


def worst_first(rows: Sequence[Row]) -> list[Row]:
    """Sort by how much of its bound a row uses; those that fail to be numbers come first, unbounded ones last."""

    def used(row: Row) -> float:
        share = row.relative / row.bound if row.bound else -1.0
        return math.inf if math.isnan(share) else share

    return sorted(rows, key=used, reverse=True)


def table(rows: Sequence[Row]) -> str:
    """Write rows as a table."""
    width = max((len(row.key) for row in rows), default=0)
    lines = [f"{'':{width}}  {'absolute':>9}  {'relative':>9}  {'bound':>7}"]
    for row in rows:
        bound = "-" if row.bound is None else f"{row.bound:.0e}"
        verdict = "" if row.holds else "  FAILS"
        note = f"  {row.note}" if row.note else ""
        lines.append(f"{row.key:{width}}  {row.absolute:9.1e}  {row.relative:9.1e}  {bound:>7}{verdict}{note}")
    return "\n".join(lines)


def write_json(path: Path, header: dict[str, Any], rows: Sequence[Row]) -> None:
    """Write rows as JSON: `header`, `holds`, and `rows` with what a `Row` has; a difference that is no number is null."""

    def number(value: float) -> float | None:
        return value if math.isfinite(value) else None

    listed = [vars(row) | {"absolute": number(row.absolute), "relative": number(row.relative), "holds": row.holds} for row in rows]
    write_atomically(path, json.dumps(header | {"holds": all(row.holds for row in rows), "rows": listed}, indent=1) + "\n")
