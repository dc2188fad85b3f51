"""Both networks on the inputs of a case, with the same weights."""

from __future__ import annotations

import jax

from cmig_jax.bench.cases import case_of, make_arrays
from cmig_jax.bench.ours import Ours
from cmig_jax.compilation import keep_compiled_programs
from cmig_jax.config import ComputeConfig
from cmig_jax.parity.recorded import named_weights
from cmig_jax.parity.twin_bench import TwinBench
from cmig_jax.parity.twin_run import state_shapes


def make_ours(name: str, device: str, compute: ComputeConfig | None = None) -> Ours:
    """Build our network on a case's inputs."""
    keep_compiled_programs()
    jax.config.update("jax_platforms", "cuda" if device == "gpu" else "cpu")
    case = case_of(name)
    return Ours(case, make_arrays(case), compute)


def make_twin(name: str, device: str) -> TwinBench:
    """Build the twin on a case's inputs, with the same weights."""
    case = case_of(name)
    arrays = make_arrays(case)
    images = arrays.views if case.images else arrays.image_features
    state = named_weights(state_shapes(case.sizes), seed=0)
    return TwinBench(
        case.sizes, state, arrays.source, arrays.target, images, arrays.R, arrays.t, device="cuda" if device == "gpu" else "cpu"
    )
