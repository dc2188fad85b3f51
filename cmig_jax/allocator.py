"""The C library's memory allocator, set so that a training step finds the memory of the step before.

A compiled step takes its working memory in one block and gives it back at its end. By default the C library returns such a block to
the system, and the system clears every page of it again at the next step: a quarter of a small network's step on a CPU. The price of
keeping it is one heap for all threads, and a compilation leaves a hundred thousand holes there, of all sizes: whoever asks for a
piece later has the C library walk through those that are too small. A step took up to twice as long, until the program ended.
"""

from __future__ import annotations

import ctypes
import platform

# Parameters of glibc's mallopt(3).
M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8

LARGE, SMALL = 2**20, 2**10  # bytes: holes between these are not used again; smaller ones are found at once


def keep_freed_memory() -> None:
    """Let this process keep the memory that it frees, for its next allocations; without effect where the C library is not glibc.

    Call it before JAX starts its threads: a thread that already has an arena of its own returns large blocks as before.
    """
    if (c := _glibc()) is not None:
        for parameter, value in ((M_ARENA_MAX, 1), (M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, -1)):
            c.mallopt(parameter, value)


def return_freed_memory() -> None:
    """Give the system what is free now: after a compilation, which leaves holes that would lie unused, or in the way, ever after."""
    if (c := _glibc()) is not None:
        c.malloc_trim(0)
        _fill_holes(c)


def _fill_holes(c: ctypes.CDLL) -> None:
    """Take every hole of the heap that is neither large nor small, for good. The system has its pages already."""
    end, size = c.sbrk(0), 2**30
    blocks: list[int] = []
    while size >= SMALL:
        block = c.malloc(size)
        if block is None or block + size > end:  # no such hole is left: the heap would grow
            c.free(block)
            size = size * 15 // 16
        else:
            blocks.append(block)
    hole: list[int] = []  # blocks side by side
    for block in [*sorted(blocks), end]:
        if hole and block != _after(c, hole[-1]):
            if _after(c, hole[-1]) - hole[0] >= LARGE:
                for piece in hole:
                    c.free(piece)
            hole = []
        hole.append(block)


def _after(c: ctypes.CDLL, block: int) -> int:
    return block + c.malloc_usable_size(block) + ctypes.sizeof(ctypes.c_size_t)  # where the next block begins


def _glibc() -> ctypes.CDLL | None:
    if platform.libc_ver()[0] != "glibc":
        return None
    c = ctypes.CDLL(None)
    c.malloc.restype, c.malloc.argtypes, c.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
    c.malloc_usable_size.restype, c.malloc_usable_size.argtypes = ctypes.c_size_t, [ctypes.c_void_p]
    c.sbrk.restype, c.sbrk.argtypes = ctypes.c_void_p, [ctypes.c_ssize_t]
    return c
