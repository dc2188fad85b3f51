"""Measure one case: times in turns, then memory, each network in processes of its own."""

from __future__ import annotations

import contextlib
import functools
from typing import Any

from tqdm import tqdm

from cmig_jax.bench.cases import case_of
from cmig_jax.bench.clock import KEPT, OURS, PYTORCH, Timing, in_turns
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
        would take at `product_rate`), `memory` of a training step, `memory_inference`, and `compile_s`. What does not fit into memory
        has no numbers.
    """
    results = _times(name, repetitions, device, compute, stages)
    if memory:
        results |= {"memory": _memory(name, "training", device, compute), "memory_inference": _memory(name, "inference", device, compute)}
    return results


def _times(name: str, repetitions: int, device: str, compute: ComputeConfig, stages: bool) -> dict[str, Any]:
    # On a GPU one after the other, so that each has all the memory.
    together: list[tuple[Who, ...]] = [(PYTORCH, KEPT, OURS)] if device == "cpu" else [(PYTORCH,), (OURS,)]
    whats = [(mode, what) for mode in ("inference", "training") for what in ("whole", *(case_of(name).stages if stages else ()))]
    timings, ours = dict.fromkeys(whats, Timing({}, 1.0)), {}
    for networks in together:
        with contextlib.ExitStack() as stack:
            workers = {who: stack.enter_context(Worker(name, who, device, compute)) for who in networks}
            for mode, what in tqdm(whats, desc=f"{name} {', '.join(networks)}", leave=False, disable=None):
                works = {who: functools.partial(worker, f"{mode} {what}") for who, worker in workers.items()}
                timings[mode, what] |= in_turns(works, repetitions)
            if OURS in workers:
                ours = workers[OURS].costs()
    results: dict[str, Any] = {"inference": {}, "training": {}}
    for (mode, what), timing in timings.items():
        results[mode][what] = timing.as_json()
        if costs := ours["costs"].get(mode if what == "whole" else f"{mode}.{what}"):
            results[mode][what] |= costs | {"floor_s": costs["operations"] / ours["product_rate"]}
    compile_s = {mode: ours["compile_seconds"][mode] for mode in results if mode in ours["compile_seconds"]}
    return results | {"compile_s": compile_s, "product_rate": ours["product_rate"]}


def _memory(name: str, what: str, device: str, compute: ComputeConfig) -> dict[str, float]:
    peaks = {who: measure(name, who, what, device, compute) for who in (PYTORCH, OURS)}
    found = {f"{who}_{field}": value for who, fields in peaks.items() for field, value in fields.items()}
    return found | ({"ratio": peaks[PYTORCH]["peak_gb"] / peaks[OURS]["peak_gb"]} if all(peaks.values()) else {})
