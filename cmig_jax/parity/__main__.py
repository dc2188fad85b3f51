"""`python -m cmig_jax.parity convert | check | compare`: weights both ways, and the numbers beside PyTorch's.

Exit code 0: done, and every comparison holds; 1: a comparison fails; 2: bad input, said in one line.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional, arg

from cmig_jax.parity import check as checking
from cmig_jax.parity import convert as converting
from cmig_jax.parity.compare import compare_live, summary
from cmig_jax.parity.files import read_torch
from cmig_jax.parity.flax_run import Dtype
from cmig_jax.parity.recorded import named_weights, random_inputs, read_case
from cmig_jax.parity.rows import Row, table, worst_first, write_json
from cmig_jax.parity.sizes import SMALL, Sizes
from cmig_jax.parity.twin_run import state_shapes
from cmig_jax.parity.weights import sizes_of_state


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    commands = {"convert": convert, "check": check, "compare": compare}
    try:
        rows = tyro.extras.subcommand_cli_from_dict(commands, prog="python -m cmig_jax.parity", args=arguments)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if all(row.holds for row in rows) else 1


def convert(
    source: Annotated[Positional[Path], arg(metavar="IN")], target: Annotated[Positional[Path], arg(metavar="OUT")], /
) -> list[Row]:
    """Convert weights between a PyTorch file (.t7, .pt, .pth, .safetensors) and a run folder, either way.

    Args:
        source: PyTorch file or run folder.
        target: PyTorch file, or run folder to make.
    """
    print("\n".join(converting.convert(source, target)))
    return []


def check(
    case: Annotated[Positional[Path], arg(metavar="CASE.npz")],
    /,
    seed: int = 0,
    iterations: int | None = None,
    dtype: Dtype = "float64",
    margins: tuple[float, float] | None = None,
    json: Path | None = None,
) -> list[Row]:
    """Hold the Flax network to a recorded case: one row per recorded key.

    Args:
        case: the recorded case.
        seed: seed of the weights, which are a function of it and each parameter's name.
        iterations: iterations of the network (default: as recorded).
        dtype: float64 from end to end, or float32 stage by stage, each fed the recorded result of the one before.
        margins: margins of the overlap loss, positive and negative (default: the loss is off).
        json: file to write the rows to.
    """
    recorded = read_case(case)
    rows = checking.check(recorded, seed, iterations, dtype, margins)
    print(table(rows))
    failing = sum(not row.holds for row in rows)
    print(f"{len(rows)} rows, " + (f"{failing} FAIL" if failing else "all hold") + "; closest to its bound: " + worst_first(rows)[0].key)
    terms = recorded.outputs.get("loss_terms")
    if failing and margins is None and terms is not None and len(terms) > 1 and terms[1] != 0:
        print("the case was recorded with the overlap loss: name its margins with --margins P N")
    if json is not None:
        header = {"case": str(case), "mode": "training" if recorded.training else "evaluation", "seed": seed, "dtype": dtype}
        write_json(json, header, rows)
    return rows


def compare(
    weights: Path | None = None,
    size: Literal["paper", "small"] = "small",
    seed: int = 0,
    pairs: int = 2,
    points: int | None = None,
    views: int = 2,
    image_size: int | None = None,
    keypoints: int | None = None,
    iterations: int | None = None,
    margins: tuple[float, float] = (6.0, 8.0),
    show: int = 25,
    json: Path | None = None,
) -> list[Row]:
    """Compare the PyTorch twin with the Flax network, live, in float64.

    Args:
        weights: PyTorch file; by default weights are drawn.
        size: size of the network, where `weights` does not say it, and of the inputs.
        seed: seed of inputs, weights and keypoints.
        pairs: pairs in the batch.
        points: points per cloud (default: 320, or 64 if small).
        views: views per pair.
        image_size: height and width of a view (default: 64, or 32 if small).
        keypoints: keypoints per cloud (default: 96, or 24 if small).
        iterations: iterations, where `weights` does not say it (default: 3, or 2 if small).
        margins: margins of the overlap loss, positive and negative.
        show: rows to print, worst first.
        json: file to write all rows to.
    """
    small = size == "small"
    state = None if weights is None else read_torch(weights)
    sizes = sizes_of_state(state) if state is not None else SMALL if small else Sizes()
    if state is None and iterations is not None:
        sizes = replace(sizes, iterations=iterations)
    sizes = replace(sizes, keypoints=keypoints or (24 if small else 96))
    inputs = random_inputs(seed, pairs, points or (64 if small else 320), views, image_size or (32 if small else 64))
    state = named_weights(state_shapes(sizes), seed) if state is None else state
    rows = worst_first(compare_live(state, sizes, inputs, margins, seed))
    print(table(rows[:show]))
    print(f"{max(len(rows) - show, 0)} more rows, further from their bounds\n\n{summary(rows)}")
    if json is not None:
        write_json(json, {"weights": str(weights) if weights else None, "size": size, "seed": seed, "dtype": "float64"}, rows)
    return rows


if __name__ == "__main__":
    sys.exit(main())
