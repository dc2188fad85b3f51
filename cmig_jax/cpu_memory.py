"""Another memory allocator for a training on a CPU: jemalloc, where it is installed. Only the command line uses it.

A compiled training step takes its working memory in a few large blocks and frees them at its end. glibc returns such blocks to the
system, which must clear every page of them again in the next step: a third of a small network's step. jemalloc (Debian and Ubuntu:
package libjemalloc2) keeps them for some seconds, if `oversize_threshold` does not exclude large blocks. `docs/performance.md` has the
measurement. Without jemalloc everything works as it is, more slowly.
"""

from __future__ import annotations

import ctypes.util
import os
import sys

SETTINGS = "oversize_threshold:0"


def environment() -> dict[str, str]:
    """Return the environment variables with which a new process uses jemalloc; empty where it is not installed, or already chosen."""
    library = ctypes.util.find_library("jemalloc") if sys.platform == "linux" else None
    preloaded = os.environ.get("LD_PRELOAD", "")
    if library is None or "malloc" in preloaded:
        return {}
    return {"LD_PRELOAD": f"{library}:{preloaded}".rstrip(":"), "MALLOC_CONF": os.environ.get("MALLOC_CONF", SETTINGS)}


def restart_with_jemalloc() -> None:
    """Start this program again, in the same process, with jemalloc; return where it is not installed or already in use."""
    changed = environment()
    if changed and sys.orig_argv:
        sys.stdout.flush()
        sys.stderr.flush()
        os.execve(sys.executable, sys.orig_argv, {**os.environ, **changed})
