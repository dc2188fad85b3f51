"""Register ever larger clouds: time and memory of each size in a process of its own, with `compute.rows` bounding memory."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, replace
from typing import Any

import jax

from cmig_jax.allocator import keep_freed_memory
from cmig_jax.bench.cases import CASES, make_arrays
from cmig_jax.bench.memory import in_a_process, resident
from cmig_jax.bench.ours import Ours
from cmig_jax.compilation import keep_compiled_programs
from cmig_jax.config import ComputeConfig


def measure_clouds(sizes: tuple[int, ...], compute: ComputeConfig, device: str = "cpu") -> list[dict[str, Any]]:
    """Measure each size: `points`, `seconds`, `peak_gb`, `above_runtime_gb`, `compile_s`."""
    return [in_a_process("cmig_jax.bench.clouds", str(N), device, json.dumps(asdict(compute))) for N in sizes]


def main(points: int, device: str, compute: ComputeConfig) -> dict[str, float]:
    """Register one pair of clouds with the paper's network, the image encoder's result given."""
    keep_freed_memory()
    keep_compiled_programs()
    jax.config.update("jax_platforms", "cuda" if device == "gpu" else "cpu")
    case = replace(CASES["points"], pairs=1, points=points)
    network = Ours(case, make_arrays(case), compute)
    before = resident("VmRSS")
    work = network.inference()
    work()
    start = time.perf_counter()
    work()
    seconds, peak = time.perf_counter() - start, network.peak_bytes() if device == "gpu" else resident("VmHWM")
    above = peak - (0 if device == "gpu" else before)
    return {
        "points": points,
        "seconds": seconds,
        "peak_gb": peak / 1e9,
        "above_runtime_gb": above / 1e9,
        "compile_s": network.compile_seconds["inference"],
    }


if __name__ == "__main__":
    points, device, compute = sys.argv[1:]
    print(json.dumps(main(int(points), device, ComputeConfig(**json.loads(compute)))))
