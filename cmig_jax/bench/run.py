"""Measure one case: times in turns, then memory, each network in processes of its own."""

from __future__ import annotations

import contextlib
import functools
from typing import Any

from tqdm import tqdm

from cmig_jax.bench.cases import CASES
from cmig_jax.bench.clock import KEPT, OURS, PYTORCH, in_turns
from cmig_jax.bench.memory import measure
from cmig_jax.bench.worker import Who, Worker
from cmig_jax.config import ComputeConfig


def run(name: str, repetitions: int, device: str, compute: ComputeConfig, memory: bool, stages: bool) -> dict[str, Any]:
    """Measure a case.

    Args:
        name: of the case.
        repetitions: of each measurement; medians are reported.
        device: `cpu` or `gpu`.
        compute: how ours computes.
        memory: also take peak memory.
        stages: also time each stage alone.

    Returns:
        `inference` and `training`, each with `whole` and the stages (`Timing.as_json`, ours' costs, and `floor_s`, what the products alone
        would take at `product_rate`), `memory` of a training step, `memory_inference`, and `compile_s`.
    """
    results = _times(name, repetitions, device, compute, stages)
    if memory:
        results |= {"memory": _memory(name, "training", device, compute), "memory_inference": _memory(name, "inference", device, compute)}
    return results


def _times(name: str, repetitions: int, device: str, compute: ComputeConfig, stages: bool) -> dict[str, Any]:
    networks: tuple[Who, ...] = (PYTORCH, KEPT, OURS) if device == "cpu" else (PYTORCH, OURS)
    whats = ["whole", *(CASES[name].stages if stages else ())]
    results: dict[str, Any] = {"inference": {}, "training": {}}
    with contextlib.ExitStack() as stack:
        workers = {who: stack.enter_context(Worker(name, who, device, compute)) for who in networks}
        for mode, found in results.items():
            for what in tqdm(whats, desc=f"{name} {mode}", leave=False, disable=None):
                works = {who: functools.partial(worker, f"{mode} {what}") for who, worker in workers.items()}
                found[what] = in_turns(works, repetitions).as_json()
        ours = workers[OURS].costs()
    for mode in ("inference", "training"):
        for what, row in results[mode].items():
            row |= ours["costs"][mode if what == "whole" else f"{mode}.{what}"]
            row["floor_s"] = row["operations"] / ours["product_rate"]
    compile_s = {mode: ours["compile_seconds"][mode] for mode in ("inference", "training")}
    return results | {"compile_s": compile_s, "product_rate": ours["product_rate"]}


def _memory(name: str, what: str, device: str, compute: ComputeConfig) -> dict[str, float]:
    theirs, ours = (measure(name, who, what, device, compute) for who in (PYTORCH, OURS))
    return {
        "ratio": theirs["peak_gb"] / ours["peak_gb"],
        "pytorch_gb": theirs["peak_gb"],
        "ours_gb": ours["peak_gb"],
        "pytorch_above_runtime_gb": theirs["above_runtime_gb"],
        "ours_above_runtime_gb": ours["above_runtime_gb"],
    }
