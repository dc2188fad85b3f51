"""One network in a process of its own, which does a piece of work when it is told to: `Worker` starts it, this module run is it.

PyTorch and JAX thus share neither threads nor the C library's memory, and PyTorch can be measured as it is installed as well as with
freed memory kept (`cmig_jax.allocator`), as ours always is.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from types import TracebackType
from typing import Any, Literal

from cmig_jax.allocator import keep_freed_memory
from cmig_jax.config import ComputeConfig

Who = Literal["pytorch", "pytorch_kept", "ours"]
COSTS = "costs"
WARM_UP = 2  # after one call the heap still grows: the next takes up to half as long again


class Worker:
    """A process that holds one network; ends with the `with` block.

    Args:
        case: name of the case.
        who: which network, and how it allocates.
        device: `cpu` or `gpu`.
        compute: how ours computes.
    """

    def __init__(self, case: str, who: Who, device: str, compute: ComputeConfig) -> None:
        command = [sys.executable, "-m", "cmig_jax.bench.worker", *arguments(case, who, device, compute)]
        environment = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}  # PyTorch needs its share of a GPU
        self._name = f"{who} ({case})"
        self._process = subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1)

    def __call__(self, work: str) -> float | None:
        """Do a piece of work (`inference whole`, `training fusion`, ...) and return its seconds; the first time also twice before.

        Returns None where the memory does not suffice.
        """
        return self._ask(work)

    def costs(self) -> dict[str, Any]:
        """Return `compile_seconds` and `costs` of ours, and the `product_rate`, operations per second."""
        return self._ask(COSTS)

    def _ask(self, line: str) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(f"{line}\n")
            answer = self._process.stdout.readline()
        except BrokenPipeError:
            answer = ""
        if not answer:
            raise RuntimeError(f"{self._name} ended with code {self._process.wait()} at {line!r}; what it said stands above")
        return json.loads(answer)

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._process.kill()
        self._process.communicate()


def arguments(case: str, who: Who, device: str, compute: ComputeConfig) -> list[str]:
    """Write what `network_of` takes as arguments of a process."""
    return [case, who, device, json.dumps(dataclasses.asdict(compute))]


def network_of(case: str, who: Who, device: str, compute: str) -> Any:
    """Build a network in this process, as `arguments` names it."""
    if who != "pytorch":
        keep_freed_memory()  # before torch or jax, which are loaded below, start their threads
    from cmig_jax.bench.networks import make_ours, make_twin

    return make_ours(case, device, ComputeConfig(**json.loads(compute))) if who == "ours" else make_twin(case, device)


def main(network: Any) -> None:
    """Answer one line of standard input after the other."""
    works: dict[str, Any] = {}
    for line in sys.stdin:
        name = line.strip()
        if name == COSTS:
            answer: Any = {"compile_seconds": network.compile_seconds, "costs": network.costs, "product_rate": network.product_rate()}
        else:
            try:
                answer = _seconds(network, works, name)
            except Exception as error:
                if not is_out_of_memory(error):
                    raise
                print(f"{name}: {error}", file=sys.stderr)
                answer = None
        print(json.dumps(answer), flush=True)


def _seconds(network: Any, works: dict[str, Any], name: str) -> float:
    if name not in works:
        mode, what = name.split()
        if what == "whole":
            works[name] = getattr(network, mode)()
        else:
            works |= {f"{mode} {stage}": work for stage, work in network.stages(mode == "training").items()}
        for _ in range(WARM_UP):
            works[name]()
    start = time.perf_counter()
    works[name]()
    return time.perf_counter() - start


def is_out_of_memory(error: Exception) -> bool:
    """Whether PyTorch, JAX or Python says that memory does not suffice: each has an error of its own."""
    said = ("RESOURCE_EXHAUSTED", "can't allocate memory")
    return isinstance(error, MemoryError) or type(error).__name__ == "OutOfMemoryError" or any(text in str(error) for text in said)


if __name__ == "__main__":
    main(network_of(*sys.argv[1:]))  # type: ignore[arg-type]
