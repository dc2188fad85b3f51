"""How XLA compiles: kept on disk, so that a run that continues or another seed starts at once; for a CPU, frugally or briefly."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import jax

from cmig_jax.allocator import return_freed_memory

T = TypeVar("T")
SECONDS_TO_GIVE_BACK = 5e-3  # seen: 0.8 to 3 ms


def keep_compiled_programs() -> str:
    """Keep what JAX compiles for later processes; return the folder: `~/.cache/cmig_jax/compiled`, or JAX_COMPILATION_CACHE_DIR."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(Path.home() / ".cache" / "cmig_jax" / "compiled")
    jax.config.update("jax_compilation_cache_dir", folder)
    return folder


def frugal() -> dict[str, str]:
    """Return options for `jax.jit` under which a CPU holds less: operations in the order that frees memory soonest.

    By default XLA orders them so that several can run at the same time; here each of the large ones takes all cores by itself.
    """
    return {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if jax.default_backend() == "cpu" else {}


def briefly() -> dict[str, int]:
    """Return options for `jax.jit` under which a CPU compiles sooner what runs once: to code that is not optimised."""
    return {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else {}


def compiled_first(function: Any) -> Callable[..., Any]:
    """Compile a `jax.jit` function at its first call, for its arguments' shapes alone, and return the compiler's memory before it runs.

    On a CPU a call returns once its working memory is free for the next (`finished`).
    """
    program = None

    def call(*arguments: Any) -> Any:
        nonlocal program
        if program is None:
            program = function.lower(*arguments).compile()
            return_freed_memory()
        results = program(*arguments)
        return finished(results) if jax.default_backend() == "cpu" else results

    return call


def finished(results: T) -> T:
    """Wait until results are there and, on a CPU, the block of memory that they were computed in is free again.

    Its thread frees it just after it has handed the results over. Who asks for the next block before that takes a second one from the
    system, or a third, and the process keeps them.
    """
    jax.block_until_ready(results)
    if jax.default_backend() == "cpu":
        time.sleep(SECONDS_TO_GIVE_BACK)
    return results
