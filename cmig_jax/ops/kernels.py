"""The choice between the plain and the fast version of an operation."""

from __future__ import annotations

import jax

from cmig_jax.config import Kernels


def is_fast(kernels: Kernels) -> bool:
    """Return whether to take the fast version; `auto` takes it on a CPU, the only backend it was measured on."""
    return kernels == "fast" or (kernels == "auto" and jax.default_backend() == "cpu")
