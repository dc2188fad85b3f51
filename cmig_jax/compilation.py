"""Compiled programs on disk: a run that continues, or another seed of it, starts without compiling again."""

from __future__ import annotations

import os
from pathlib import Path

import jax


def keep_compiled_programs() -> str:
    """Keep what JAX compiles for later processes; return the folder: `~/.cache/cmig_jax/compiled`, or JAX_COMPILATION_CACHE_DIR."""
    folder = os.environ.get("JAX_COMPILATION_CACHE_DIR") or str(Path.home() / ".cache" / "cmig_jax" / "compiled")
    jax.config.update("jax_compilation_cache_dir", folder)
    return folder
