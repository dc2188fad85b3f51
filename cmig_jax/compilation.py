"""How XLA compiles: a cache on disk, and compiler options for programs on a CPU."""

from __future__ import annotations

import os
from pathlib import Path

import jax


def keep_compiled_programs() -> str:
    """Keep compiled programs for later processes; return the folder: `~/.cache/cmig_jax/compiled`, or JAX_COMPILATION_CACHE_DIR."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(Path.home() / ".cache" / "cmig_jax" / "compiled")
    jax.config.update("jax_compilation_cache_dir", folder)
    return folder


def less_memory() -> dict[str, str]:
    """Return options for `jax.jit` that order the operations on a CPU so that memory is freed soonest.

    XLA's default order lets several operations run at the same time; here each of the large ones takes all cores by itself.
    """
    return {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if jax.default_backend() == "cpu" else {}


def compile_quickly() -> dict[str, int]:
    """Return options for `jax.jit` that compile a program for a CPU without optimisation: it runs once."""
    return {"xla_backend_optimization_level": 0} if jax.default_backend() == "cpu" else {}
