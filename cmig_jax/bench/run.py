"""Measure one case: times in turns, memory in separate processes."""

from __future__ import annotations

from typing import Any

from tqdm import tqdm

from cmig_jax.bench.clock import in_turns
from cmig_jax.bench.memory import measure
from cmig_jax.bench.networks import make_ours, make_twin


def run(name: str, repetitions: int, device: str, rows: int, memory: bool, stages: bool) -> dict[str, Any]:
    """Measure a case.

    Args:
        name: of the case.
        repetitions: of each measurement; medians are reported.
        device: `cpu` or `gpu`.
        rows: `compute.rows` of ours.
        memory: also take peak memory, each network in processes of its own.
        stages: also time each stage alone.

    Returns:
        `inference` and `training`, each with `whole` and the stages (`ratio`, `pytorch_s`, `ours_s`), `memory` of a training step,
        `memory_inference`, and `compile_s`; `ratio` is PyTorch over ours.
    """
    results = _times(name, repetitions, device, rows, stages)
    if memory:
        results |= {"memory": _memory(name, "training", device, rows), "memory_inference": _memory(name, "inference", device, rows)}
    return results


def _times(name: str, repetitions: int, device: str, rows: int, stages: bool) -> dict[str, Any]:
    ours, twin = make_ours(name, device, rows), make_twin(name, device)
    results: dict[str, Any] = {"inference": {}, "training": {}}
    for mode, train in (("inference", False), ("training", True)):
        pairs = {"whole": (twin.training() if train else twin.inference(), ours.training() if train else ours.inference())}
        if stages:
            theirs, own = twin.stages(train), ours.stages(train)
            pairs |= {stage: (theirs[stage], own[stage]) for stage in own}
        for what, works in tqdm(pairs.items(), desc=f"{name} {mode}", leave=False, disable=None):
            results[mode][what] = in_turns(*works, repetitions).as_json() | ours.costs[mode if what == "whole" else f"{mode}.{what}"]
    results["compile_s"] = {mode: ours.compile_seconds[mode] for mode in ("inference", "training")}
    return results


def _memory(name: str, what: str, device: str, rows: int) -> dict[str, float]:
    theirs, ours = (measure(name, who, what, device, rows) for who in ("pytorch", "ours"))
    return {
        "ratio": theirs["peak_gb"] / ours["peak_gb"],
        "pytorch_gb": theirs["peak_gb"],
        "ours_gb": ours["peak_gb"],
        "pytorch_above_runtime_gb": theirs["above_runtime_gb"],
        "ours_above_runtime_gb": ours["above_runtime_gb"],
    }
