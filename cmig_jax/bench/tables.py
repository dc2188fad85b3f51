"""What `cmig bench` prints."""

from __future__ import annotations

from typing import Any

from cmig_jax.bench.cases import case_of
from cmig_jax.bench.run import MODES


def case_lines(name: str, result: dict[str, Any]) -> list[str]:
    """Write a case as a table; what does not fit into memory, or was not measured, is a dash."""
    case = case_of(name)
    images = f"{case.views} views of {case.image_size} x {case.image_size}" if case.images else "image features given"
    columns = (("PyTorch s", 10, 3), ("kept s", 8, 3), ("ours s", 8, 3), ("ms a pair", 10, 2), ("ratio", 6, 2), ("kept", 6, 2))
    columns += (("Gop", 8, 1), ("GB", 7, 2), ("floor s", 8, 3))
    lines = [f"{name}: {case.pairs} pairs of {case.points} points, {images}"]
    lines.append("  " + " ".join((f"{'':26}", *(f"{title:>{width}}" for title, width, _ in columns))))
    for mode in MODES:
        for what, row in result[mode].items():
            numbers = [row.get(key) for key in ("pytorch_s", "pytorch_kept_s", "ours_s")]
            numbers.append(row["ours_s"] / case.pairs * 1e3 if "ours_s" in row else None)
            numbers += [row.get("ratio"), row.get("ratio_kept")]
            numbers += [row[key] / 1e9 if key in row else None for key in ("operations", "bytes")] + [row.get("floor_s")]
            cells = [_cell(number, width, digits) for number, (_, width, digits) in zip(numbers, columns, strict=True)]
            lines.append("  " + " ".join((f"{mode + ' ' + what:26}", *cells)))
    for mode, row in result.get("memory", {}).items():
        theirs, ours, ratio = (_cell(row.get(field), 7, 2) for field in ("pytorch_peak_gb", "ours_peak_gb", "ratio"))
        lines.append(f"  peak memory, {mode:13} {theirs} GB {ours} GB {ratio}")
    rate = result["product_rate"] / 1e9
    lines.append(f"  Gop, GB: of our products, read and written once; floor: those at {rate:.0f} Gop/s, the rate of one large product here")
    compiled = ", ".join(f"{mode} {seconds:.1f} s" for mode, seconds in result["compile_s"].items())
    return [*lines, f"  compilation (ours, or its reading from the cache): {compiled}"]


def cloud_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Write the table of cloud sizes."""
    columns = (("points", 7, 0), ("seconds", 8, 2), ("peak_gb", 8, 2), ("above_runtime_gb", 17, 2))
    head = " ".join(f"{title.replace('_', ' '):>{width}}" for title, width, _ in columns)
    return [head, *(" ".join(_cell(row.get(key), width, digits) for key, width, digits in columns) for row in rows)]


def _cell(number: float | None, width: int, digits: int) -> str:
    return f"{'-':>{width}}" if number is None else f"{number:{width}.{digits}f}"
