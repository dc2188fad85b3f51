"""The C library's memory allocator, set so that a training step finds the memory of the step before.

A compiled step takes its working memory in one block and gives it back at its end. By default the C library returns such a block to
the system, and the system clears every page of it again at the next step: a quarter of a small network's step on a CPU.
"""

from __future__ import annotations

import contextlib
import ctypes
import platform

# Parameters of glibc's mallopt(3).
M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, for its next allocations; without effect where the C library is not glibc.

    Call it before JAX starts its threads: a thread that already has an arena of its own returns large blocks as before.
    """
    for parameter, value in ((M_ARENA_MAX, 1), (M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, -1)):
        _call_glibc("mallopt", parameter, value)


def return_freed_memory() -> None:
    """Give the system what is free now: after a compilation, whose many small pieces would lie unused below a step's working memory."""
    _call_glibc("malloc_trim", 0)


def _call_glibc(name: str, *arguments: int) -> None:
    if platform.libc_ver()[0] == "glibc":
        with contextlib.suppress(OSError, AttributeError):
            getattr(ctypes.CDLL(None), name)(*arguments)
