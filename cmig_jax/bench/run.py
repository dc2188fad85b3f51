"""Measure a case: times in turns, then memory, each network in processes of its own."""

from __future__ import annotations

import contextlib
import functools
import sys
from dataclasses import dataclass, field
from typing import Any

from tqdm import tqdm

from cmig_jax import cpu_memory
from cmig_jax.bench.cases import case_of
from cmig_jax.bench.clock import KEPT, OURS, PYTORCH, Timing, in_turns
from cmig_jax.bench.worker import Worker
from cmig_jax.config import ComputeConfig

MODES = ("inference", "training")
KEEP_FREED_MEMORY = {"MALLOC_ARENA_MAX": "1", "MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "-1"}
"""Settings of glibc with which a process reuses the memory that it frees. PyTorch is faster with them than with jemalloc."""


@dataclass(frozen=True)
class Settings:
    """How to measure.

    Attributes:
        device: `cpu` or `gpu`.
        compute: how ours computes.
        repetitions: of each measurement; medians are reported.
        jemalloc: ours runs with it where it is installed, as a training does.
    """

    device: str = "cpu"
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    repetitions: int = 5
    jemalloc: bool = True

    def worker(self, name: str, who: str) -> Worker:
        """Start one of the networks `OURS`, `PYTORCH` and `KEPT`, PyTorch that keeps the memory that it frees."""
        allocators = {PYTORCH: {}, KEPT: KEEP_FREED_MEMORY, OURS: cpu_memory.environment() if self.jemalloc else {}}
        return Worker(name, "ours" if who == OURS else "pytorch", self.device, self.compute, allocators[who])

    def together(self) -> list[tuple[str, ...]]:
        """Return which networks take turns: on a GPU one after the other, so that each has all the memory."""
        if self.device == "gpu":
            return [(PYTORCH,), (OURS,)]
        return [(PYTORCH, KEPT, OURS)] if sys.platform == "linux" else [(PYTORCH, OURS)]


def times(name: str, settings: Settings, stages: bool) -> dict[str, Any]:
    """Measure the time of a case.

    Args:
        name: of the case.
        settings: how to measure.
        stages: also time each stage alone.

    Returns:
        `inference` and `training`, each with `whole` and the stages (`Timing.as_json`, the costs of ours, and `floor_s`, what the
        products alone would take at `product_rate`), and `compile_s`. What does not fit into memory has no numbers.
    """
    whats = [(mode, what) for mode in MODES for what in ("whole", *(case_of(name).stages if stages else ()))]
    timings, ours, rate = dict.fromkeys(whats, Timing({}, 1.0)), {}, 0.0
    for networks in settings.together():
        with contextlib.ExitStack() as stack:
            workers = {who: stack.enter_context(settings.worker(name, who)) for who in networks}
            for mode, what in tqdm(whats, desc=f"{name} {', '.join(networks)}", leave=False, disable=None):
                works = {who: functools.partial(worker, f"{mode} {what}") for who, worker in workers.items()}
                timings[mode, what] |= in_turns(works, settings.repetitions)
            if OURS in workers:
                ours, rate = workers[OURS].costs(), workers[OURS].product_rate()
    results: dict[str, Any] = {mode: {} for mode in MODES}
    for (mode, what), timing in timings.items():
        results[mode][what] = timing.as_json()
        if costs := ours["costs"].get(mode if what == "whole" else f"{mode} {what}"):
            results[mode][what] |= costs | {"floor_s": costs["operations"] / rate}
    compile_s = {mode: ours["compile_seconds"][mode] for mode in MODES if mode in ours["compile_seconds"]}
    return results | {"compile_s": compile_s, "product_rate": rate}


def memory(name: str, settings: Settings) -> dict[str, Any]:
    """Measure peak memory of `training` and `inference`, each network and each mode in a new process."""
    results: dict[str, Any] = {}
    for mode in reversed(MODES):
        peaks: dict[str, dict[str, float]] = {}
        for who in (PYTORCH, OURS):
            with settings.worker(name, who) as worker:
                peaks[who] = worker.memory(mode)
        row = {f"{who}_{field}": value for who, fields in peaks.items() for field, value in fields.items()}
        results[mode] = row | ({"ratio": peaks[PYTORCH]["peak_gb"] / peaks[OURS]["peak_gb"]} if all(peaks.values()) else {})
    return {"memory": results}


def clouds(sizes: tuple[int, ...], settings: Settings) -> list[dict[str, Any]]:
    """Register one pair of clouds of each size with our network alone: `points`, `seconds`, `peak_gb`, `above_runtime_gb`."""
    rows = []
    for points in tqdm(sizes, desc="clouds", leave=False, disable=None):
        with settings.worker(f"points:1:{points}", OURS) as worker:
            rows.append({"points": points, **worker.memory("inference"), "seconds": worker("inference whole")})
    return rows
