"""`python -m cmig_jax.bench`: ours beside the PyTorch twin, same weights and inputs, in turns; a table and, if wanted, JSON."""

from __future__ import annotations

import dataclasses
import json as serialiser
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import jax
import tyro

from cmig_jax.bench.cases import CASES, case_of
from cmig_jax.bench.clouds import measure_clouds
from cmig_jax.bench.run import run
from cmig_jax.compilation import keep_compiled_programs
from cmig_jax.config import ComputeConfig
from cmig_jax.training.checkpoint import write_atomically

DEFAULT = ComputeConfig()


def main(
    cases: tuple[Literal["paper", "points", "quickstart", "tiny"], ...] = ("paper", "points", "quickstart"),
    device: Literal["cpu", "gpu"] = "cpu",
    repetitions: int = 5,
    compute: ComputeConfig = DEFAULT,
    stages: bool = True,
    memory: bool = True,
    pairs: tuple[int, ...] = (),
    clouds: tuple[int, ...] = (),
    json: Path | None = None,
) -> None:
    """Compare time and memory with the PyTorch twin: as it is installed, and keeping the memory that it frees, as ours does.

    Args:
        cases: `paper`: batch of 2 pairs, 768 points, 20 views of 224 x 224, K = 256, n = 3, float32; `points`: that without the image
            encoder, whose result both are given; `quickstart`: the small preset's network and batch; `tiny`: for tests.
        device: where to compute.
        repetitions: of every measurement; medians are reported.
        compute: how our network computes.
        stages: also time every stage alone.
        memory: also take peak memory, in separate processes.
        pairs: batch sizes to measure every case at (`paper:16`, ...); its own if not given.
        clouds: instead, register clouds of these sizes with our network (`--compute.rows` is 512 if not given) and print time and memory.
        json: file to write the results to.
    """
    if repetitions < 1:
        sys.exit(f"error: --repetitions {repetitions}: expected at least 1")
    if pairs and min(pairs) < 1:
        sys.exit(f"error: --pairs {min(pairs)}: expected at least 1")
    if clouds and min(clouds) < (fewest := CASES["points"].sizes.keypoints):
        sys.exit(f"error: --clouds {min(clouds)}: expected at least {fewest} points, the network's keypoints")
    if json is not None and not json.parent.is_dir():
        sys.exit(f"error: --json {json}: expected a file in a folder that is there")
    if device == "gpu" and not has_gpu():
        sys.exit("error: --device gpu: JAX finds none here")
    if clouds:
        results: dict[str, Any] = {"clouds": measure_clouds(clouds, dataclasses.replace(compute, rows=compute.rows or 512), device)}
        print("\n".join(cloud_lines(results["clouds"])))
    else:
        cache = keep_compiled_programs()
        print(f"persistent compilation cache: {cache}")
        results = {}
        for name in [f"{case}:{count}" for case in cases for count in pairs] or cases:
            results[name] = run(name, repetitions, device, compute, memory, stages)
            print("\n".join(case_lines(name, results[name])), flush=True)
    if json is not None:
        header = {"device": device, "repetitions": repetitions, "compute": dataclasses.asdict(compute), "jax": jax.__version__}
        write_atomically(json, serialiser.dumps(header | results, indent=1) + "\n")


def has_gpu() -> bool:
    """Whether JAX finds a GPU; asked in another process, since JAX takes most of its memory as soon as it looks."""
    return subprocess.run([sys.executable, "-c", "import jax; jax.devices('gpu')"], capture_output=True, check=False).returncode == 0


def case_lines(name: str, result: dict[str, Any]) -> list[str]:
    """Write a case as a table; what does not fit into memory has no number."""
    case = case_of(name)
    images = f"{case.views} views of {case.image_size} x {case.image_size}" if case.images else "image features given"
    lines = [f"{name}: {case.pairs} pairs of {case.points} points, {images}, K = {case.sizes.keypoints}, n = {case.sizes.iterations}"]
    columns = (("PyTorch s", 10, 3), ("kept s", 8, 3), ("ours s", 8, 3), ("ms a pair", 10, 2), ("ratio", 6, 2), ("kept", 6, 2))
    columns += (("Gop", 8, 1), ("GB", 7, 2), ("floor s", 8, 3))
    lines.append("  " + " ".join((f"{'':26}", *(f"{title:>{width}}" for title, width, _ in columns))))
    for mode in ("inference", "training"):
        for what, row in result[mode].items():
            numbers = [row.get(key) for key in ("pytorch_s", "pytorch_kept_s", "ours_s")]
            numbers.append(row["ours_s"] / case.pairs * 1e3 if "ours_s" in row else None)
            numbers += [row.get("ratio"), row.get("ratio_kept")]
            numbers += [row[key] / 1e9 if key in row else None for key in ("operations", "bytes")] + [row.get("floor_s")]
            cells = [_cell(number, width, digits) for number, (_, width, digits) in zip(numbers, columns, strict=True)]
            lines.append("  " + " ".join((f"{mode + ' ' + what:26}", *cells)))
    for what, key in (("training", "memory"), ("inference", "memory_inference")):
        if key in result:
            row = result[key]
            theirs, ours, ratio = (_cell(row.get(field), 7, 2) for field in ("pytorch_peak_gb", "ours_peak_gb", "ratio"))
            lines.append(f"  peak memory, {what:13} {theirs} GB {ours} GB {ratio}")
    rate = result["product_rate"] / 1e9
    lines.append(f"  Gop, GB: of our products, read and written once; floor: those at {rate:.0f} Gop/s, the rate of one large product here")
    compiled = ", ".join(f"{mode} {seconds:.1f} s" for mode, seconds in result["compile_s"].items())
    return [*lines, f"  compilation (ours, or its reading from the cache): {compiled}"]


def _cell(number: float | None, width: int, digits: int) -> str:
    return f"{'-':>{width}}" if number is None else f"{number:{width}.{digits}f}"


def cloud_lines(rows: list[dict[str, float]]) -> list[str]:
    """Write the table of cloud sizes."""
    head = f"{'points':>7} {'seconds':>8} {'peak GB':>8} {'above the runtime GB':>21} {'compile s':>10}"
    body = [
        f"{r['points']:7.0f} {r['seconds']:8.2f} {r['peak_gb']:8.2f} {r['above_runtime_gb']:21.2f} {r['compile_s']:10.1f}" for r in rows
    ]
    return [head, *body]


if __name__ == "__main__":
    tyro.cli(main, prog="python -m cmig_jax.bench")
