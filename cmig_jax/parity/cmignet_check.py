"""Hold CMIGNet to the recorded results of the reference, key by key.

In float64 the network runs from end to end. In float32 every stage reads what the reference computed before it (the recorded result, or
our float64 one where the case holds only a summary), since one changed neighbour or argmax changes everything after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cmig_jax.config import ComputeConfig, Config, Kernels
from cmig_jax.models.cmignet.flags import CMIGNetFlags, released
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.cmignet_layout import layout, with_margins
from cmig_jax.parity.cmignet_run import run_flax
from cmig_jax.parity.cmignet_ties import recorded_choices, resolve
from cmig_jax.parity.rows import Dtype, Row, compare_all
from cmig_jax.parity.weights import to_flax


def flags_of_case(case: Case, iterations: int | None = None, margins: tuple[float, float] | None = None) -> CMIGNetFlags:
    """Return the flags of the released network with the keypoints and iterations of a case.

    Args:
        case: the recorded case.
        iterations: of the network, by default as many as are recorded.
        margins: of the overlap loss; None is off.

    Raises:
        ValueError: the case has no iteration.
    """
    firsts = [value.shape[1] for key, value in case.outputs.items() if key in ("it0/logit", "it0/kept")]
    if not firsts:
        raise ValueError("expected a recorded case of CMIGNet: its outputs have no it0/logit")
    flags, recorded = with_margins(released(), margins), len({key.split("/")[0] for key in case.outputs if key.startswith("it")})
    matching = replace(flags.matching, iterations=iterations or recorded)
    return replace(flags, keypoints=replace(flags.keypoints, count=firsts[0]), matching=matching)


def check(case: Case, flags: CMIGNetFlags, state: State, dtype: Dtype = "float64", kernels: Kernels = "auto") -> list[Row]:
    """Compare CMIGNet with every recorded result of a case.

    Args:
        case: the recorded case.
        flags: of the network.
        state: weights under PyTorch names.
        dtype: what to compute in.
        kernels: which version of each operation.

    Returns:
        One row per recorded key.
    """
    config = Config(name="released", model=flags, compute=ComputeConfig(kernels=kernels))
    variables, beside = to_flax(state, layout(flags))
    unused = {f"statistics/{name}": value for name, value in beside.items()}

    def run(dtype: Dtype, forced: Arrays) -> Arrays:
        return unused | run_flax(config, variables, case.inputs, dtype, forced)

    rows, results = _compared(case, flags.keypoints.count, run, "float64", {})
    if dtype == "float32":
        stages = {name: value for name, value in results.items() if not name.startswith(("gradient/", "statistics/"))}
        forced = {name: case.outputs.get(name, value) for name, value in stages.items()}
        rows, _ = _compared(case, flags.keypoints.count, run, "float32", forced)
    return rows


def _compared(case: Case, keypoints: int, run: Callable[[Dtype, Arrays], Arrays], dtype: Dtype, forced: Arrays) -> tuple[list[Row], Arrays]:
    """Run and compare; return the rows, and the results that choose as recorded.

    Where rows fail and a choice differs from the recorded one by rounding only, the network runs again with the values that it chose from
    moved, so that it chooses as recorded. Rows that hold then are ties; all others fail.
    """
    results = run(dtype, forced)
    rows = compare_all(case.outputs, results, dtype)
    for name, recorded in recorded_choices(case, keypoints).items():
        if all(row.holds for row in rows) or name not in results:
            break
        note, moved = resolve(name, results[name], recorded, results | forced, dtype)
        if moved:
            forced = forced | moved
            results = run(dtype, forced)
            again = zip(rows, compare_all(case.outputs, results, dtype), strict=True)
            rows = [replace(row, tie=True, note=note) if not row.holds and new.holds else row for row, new in again]
    return rows, results
