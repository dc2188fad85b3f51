"""Hold the Flax network to a recorded case, key by key.

In float64 the network runs from end to end. In float32 every stage runs alone, fed the recorded result of the stage before it (the
twin's, where the case holds only a summary), since one changed neighbour or argmax changes everything after it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np

from cmig_jax.parity.flax_run import Dtype, run_flax
from cmig_jax.parity.recorded import Case, Run, named_weights
from cmig_jax.parity.rows import OUTPUT_BOUND, STAGE_BOUND, STATE_BOUND, Row, compare
from cmig_jax.parity.sizes import Sizes, released
from cmig_jax.parity.stages import run_stages
from cmig_jax.parity.twin_run import make_twin, run_twin, state_shapes
from cmig_jax.parity.weights import to_flax

# A recorded gradient norm below this share of the largest is rounding: a bias before a norm or a softmax has no gradient. It is held
# to its bound relative to a share of the largest norm instead of to itself.
NO_GRADIENT = 1e-7
ROUNDING = {"float64": 1e-7, "float32": 1e-2}


def check(
    case: Case,
    seed: int = 0,
    iterations: int | None = None,
    dtype: Dtype = "float64",
    margins: tuple[float, float] | None = None,
    sizes: Sizes | None = None,
) -> list[Row]:
    """Compare the Flax network with every number of a case.

    Args:
        case: inputs and recorded outputs; numbers of pairs, points, views, pixels and keypoints are its own.
        seed: of the weights.
        iterations: of the network; by default as many as are recorded.
        dtype: what to compute in.
        margins: of the overlap loss; None is off.
        sizes: widths of the network, by default the released ones.

    Returns:
        one row per recorded key.
    """
    sizes = replace(sizes or Sizes(), keypoints=case.keypoints, iterations=iterations or case.iterations)
    state = named_weights(state_shapes(sizes), seed)
    config, converted = released(sizes, margins), to_flax(state, sizes)
    if dtype == "float64":
        run = run_flax(config, converted.variables, case.inputs, case.training)
    else:
        reference = run_twin(make_twin(sizes, state, margins=margins), case.inputs, case.training)
        recorded = {name: value for name, value in case.outputs.items() if name in reference.outputs}
        reference = dataclasses.replace(reference, outputs=reference.outputs | recorded)
        run = run_stages(config, converted.variables, case.inputs, reference, case.training, dtype)
    untouched = {name: value for name, value in converted.kept.items() if name.endswith(("running_mean", "running_var"))}
    return _rows(case, dataclasses.replace(run, buffers=untouched | run.buffers), dtype)


def _rows(case: Case, run: Run, dtype: Dtype) -> list[Row]:
    norms = [float(value) for key, value in case.outputs.items() if key.startswith("grad_norm/")]
    largest = max(norms, default=0.0)
    rows = []
    for key, expected in case.outputs.items():
        kind, _, name = key.partition("/")
        bound, floor, elementwise = OUTPUT_BOUND, 0.0, key == "loss_terms"
        if kind == "grad_norm":
            bound, floor = STATE_BOUND, ROUNDING[dtype] * largest if expected < NO_GRADIENT * largest else 0.0
        elif kind == "buffer_sum":
            bound = STATE_BOUND
            if dtype == "float32" and name in run.buffers:  # a sum that cancels keeps the rounding of its terms
                floor = float(np.abs(run.buffers[name]).sum())
        elif key.endswith("/stats"):
            elementwise = dtype == "float64"
        rows.append(compare(key, run.recorded(key), expected, bound if dtype == "float64" else STAGE_BOUND, floor, elementwise))
    return rows
