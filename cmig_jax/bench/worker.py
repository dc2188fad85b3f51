"""One network in a process of its own, which does a piece of work when it is told to: `Worker` starts it, this module run is it.

PyTorch and JAX thus share neither threads nor an allocator, and each can be measured with settings of its own for memory.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from cmig_jax.bench.clock import OURS
from cmig_jax.config import ComputeConfig

COSTS, RATE, MEMORY = "costs", "rate", "memory"
WARM_UP = 2  # after one call the heap still grows: the next takes up to half as long again


class Worker:
    """A process that holds one network; ends with the `with` block.

    Args:
        case: name of the case.
        who: which network.
        device: `cpu` or `gpu`.
        compute: how ours computes.
        allocator: environment variables that choose or set the memory allocator.
    """

    def __init__(
        self, case: str, who: Literal["ours", "pytorch"], device: str, compute: ComputeConfig, allocator: Mapping[str, str]
    ) -> None:
        command = [sys.executable, "-m", "cmig_jax.bench.worker", case, who, device, json.dumps(asdict(compute))]
        environment = {**os.environ, **allocator, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # PyTorch needs its share of a GPU
        self._name = f"{who} ({case})"
        self._process = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)

    def __call__(self, work: str) -> float | None:
        """Do a piece of work (`inference whole`, `training fusion`, ...) and return its seconds; the first time also twice before.

        Returns None where the memory does not suffice.
        """
        return self._ask(work)

    def costs(self) -> dict[str, Any]:
        """Return `compile_seconds` and `costs` of ours."""
        return self._ask(COSTS)

    def product_rate(self) -> float:
        """Return the operations per second of one large product in the type of our layers."""
        return self._ask(RATE)

    def memory(self, mode: str) -> dict[str, float]:
        """Do `inference` or `training` twice.

        Returns:
            `peak_gb`, the largest resident memory of the process (of the device, on a GPU), and `above_runtime_gb`, without what the
            process held once libraries, weights and inputs were loaded; empty if memory does not suffice.
        """
        return self._ask(f"{MEMORY} {mode}") or {}

    def _ask(self, line: str) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(f"{line}\n")
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise RuntimeError(f"{self._name} ended with code {self._process.wait()} at {line!r}; its message is above")
        return json.loads(answer)

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._process.kill()
        self._process.communicate()


def network_of(case: str, who: str, device: str, compute: ComputeConfig) -> Any:
    """Build a network in this process."""
    from cmig_jax.bench.cases import case_of

    found = case_of(case)
    if who != OURS:
        return found.reference("cuda" if device == "gpu" else "cpu")
    import jax

    from cmig_jax.bench.ours import Ours
    from cmig_jax.compilation import keep_compiled_programs

    keep_compiled_programs()
    jax.config.update("jax_platforms", "cuda" if device == "gpu" else "cpu")
    return Ours(found, compute)


def main(network: Any, device: str) -> None:
    """Answer one line of standard input after the other."""
    works: dict[str, Any] = {}
    for line in sys.stdin:
        print(json.dumps(_answer(network, works, line.strip(), device)), flush=True)


def _answer(network: Any, works: dict[str, Any], asked: str, device: str) -> Any:
    if asked == COSTS:
        return {"compile_seconds": network.compile_seconds, "costs": network.costs}
    if asked == RATE:
        from cmig_jax.bench.products import product_rate

        return product_rate(network.config.compute.dtype)
    mode, what = asked.split()
    try:
        return _peaks(network, what, device) if mode == MEMORY else _seconds(network, works, mode, what)
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        print(f"{asked}: {error}", file=sys.stderr)
        return None


def _seconds(network: Any, works: dict[str, Any], mode: str, what: str) -> float:
    name = f"{mode} {what}"
    if name not in works:
        if what == "whole":
            works[name] = getattr(network, mode)()
        else:
            works |= {f"{mode} {stage}": work for stage, work in network.stages(mode == "training").items()}
        for _ in range(WARM_UP):
            works[name]()
    start = time.perf_counter()
    works[name]()
    return time.perf_counter() - start


def _peaks(network: Any, mode: str, device: str) -> dict[str, float]:
    before = 0 if device == "gpu" else resident("VmRSS")
    work = getattr(network, mode)()
    work()
    work()
    peak = network.peak_bytes() if device == "gpu" else resident("VmHWM")
    return {"peak_gb": peak / 1e9, "above_runtime_gb": (peak - before) / 1e9}


def resident(field: Literal["VmHWM", "VmRSS"]) -> int:
    """Return the largest (VmHWM) or present (VmRSS) resident memory of this process, bytes; 0 where the system does not say."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(field)), 0)


def is_out_of_memory(error: Exception) -> bool:
    """Whether PyTorch, JAX or Python says that memory does not suffice: each has an error of its own."""
    said = ("RESOURCE_EXHAUSTED", "can't allocate memory")
    return isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or any(text in str(error) for text in said)


if __name__ == "__main__":
    case, who, device, compute = sys.argv[1:]
    main(network_of(case, who, device, ComputeConfig(**json.loads(compute))), device)
