"""`cmig parity convert | check | compare`: weights both ways, and the numbers beside PyTorch's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg, subcommand

from cmig_jax.commands.parsing import parser_of
from cmig_jax.config import Kernels
from cmig_jax.parity.cases import State
from cmig_jax.parity.rows import Dtype, Row, summary, table, used, write_json

RELEASED = Path(__file__).parents[1] / "parity" / "released.npz"
"""What the released network computed in training and in evaluation mode; comes with the package."""


@dataclass(frozen=True)
class Convert:
    """Convert weights between a PyTorch file (.t7, .pt, .pth, .safetensors) and a run folder, either way."""

    source: Annotated[Positional[Path], arg(metavar="IN")]
    """PyTorch file or run folder."""
    target: Annotated[Positional[Path], arg(metavar="OUT")]
    """PyTorch file, or run folder to make."""


@dataclass(frozen=True)
class _Common:
    seed: int = 0
    """Seed of the weights, which are a function of it and each parameter's name, and of what else is drawn."""
    iterations: int | None = None
    """Iterations of the network (default: as recorded, as in `weights`, or 3, or 2 if small)."""
    kernels: Kernels = "auto"
    """Implementation of the operations, as `compute.kernels`."""
    json: Path | None = None
    """File to write the rows to."""


@dataclass(frozen=True)
class Check(_Common):
    """Hold a network to a recorded case of its PyTorch implementation: one row per recorded result."""

    case: Annotated[Positional[Path | None], arg(metavar="CASE.npz")] = None
    """The recorded case; by default CMIGNet's, which comes with the package."""
    method: str = "cmignet"
    """What was recorded: `cmignet`, or another method (`cmig_jax/parity/methods`), by the name of its folder of recorded cases. Of
    other methods only `seed`, `kernels`, `weights` and `json` are read, and all is computed in float64."""
    weights: Path | None = None
    """PyTorch file of the weights that the case was recorded with (default: the weights that `seed` names)."""
    dtype: Dtype = "float64"
    """float64 from end to end, or float32 stage by stage, each fed the reference's result of the stage before."""
    margins: tuple[float, float] | None = None
    """Margins of the overlap loss, positive and negative (default: the loss is off)."""


@dataclass(frozen=True)
class Compare(_Common):
    """Compare a PyTorch twin of the released network with CMIGNet, live, in float64."""

    weights: Path | None = None
    """PyTorch file (default: weights are drawn)."""
    size: Literal["paper", "small"] = "small"
    """Size of the network, where `weights` does not say it, and of the inputs."""
    pairs: int = 2
    """Pairs in the batch."""
    points: int | None = None
    """Points per cloud (default: 320, or 64 if small)."""
    views: int = 2
    """Views per pair."""
    image_size: int | None = None
    """Height and width of a view, pixels (default: 64, or 32 if small)."""
    keypoints: int | None = None
    """Keypoints per cloud (default: 96, or 24 if small)."""
    margins: tuple[float, float] = (6.0, 8.0)
    """Margins of the overlap loss, positive and negative."""
    show: int = 25
    """Rows to print, worst first."""


Command = Convert | Check | Compare
parse = parser_of(
    Annotated[Convert, subcommand("convert")] | Annotated[Check, subcommand("check")] | Annotated[Compare, subcommand("compare")]
)


def run(command: Command) -> int:
    """Convert, or print and write a comparison; return 1 if it fails.

    Raises:
        ValueError: a bad file, sizes that do not fit, or PyTorch is missing where it is needed.
    """
    try:
        if isinstance(command, Convert):
            from cmig_jax.parity.convert import convert

            print("\n".join(convert(command.source, command.target)))
            return 0
        if isinstance(command, Compare):
            rows = _compare(command)
        else:
            rows = _check(command) if command.method == "cmignet" else _check_method(command)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in ("torch", "safetensors"):
            raise
        raise ValueError(f"{package} is not installed: pip install 'cmig_jax[parity]'") from error
    if command.json is not None:
        header = {name: str(value) if isinstance(value, Path) else value for name, value in vars(command).items()}
        write_json(command.json, header, rows)
    return int(not all(row.holds for row in rows))


def _check(command: Check) -> list[Row]:
    from cmig_jax.parity.cases import EVALUATION, read_cases
    from cmig_jax.parity.cmignet_check import check, flags_of_case
    from cmig_jax.parity.cmignet_layout import layout
    from cmig_jax.parity.cmignet_run import INPUTS, TRAINING_INPUTS
    from cmig_jax.parity.weights import named_weights

    rows = []
    for number, case in enumerate(read_cases(command.case or RELEASED, INPUTS, TRAINING_INPUTS)):
        flags = flags_of_case(case, command.iterations, command.margins)
        state = _read_weights(command.weights) if command.weights else named_weights(layout(flags), command.seed)
        found = check(case, flags, state, command.dtype, command.kernels)
        rows += [replace(row, key=EVALUATION + row.key) for row in found] if number else found
        if command.margins is None and "loss_terms" in case.outputs and case.outputs["loss_terms"][1] != 0:
            print("the case was recorded with the overlap loss: name its margins with --margins P N")
    print(f"{table(rows)}\n")
    print(summary(rows, lambda key: key.split("/")[0] if key.startswith(("grad_norm/", "buffer_sum/", EVALUATION)) else "outputs"))
    return rows


def _check_method(command: Check) -> list[Row]:
    from cmig_jax.parity.cases import read_cases
    from cmig_jax.parity.method import check_method, weights_of
    from cmig_jax.parity.methods import METHODS

    if command.method not in METHODS:
        raise ValueError(f"method = {command.method!r}: expected cmignet, or one of {', '.join(METHODS)}")
    if command.case is None:
        raise ValueError(f"expected a recorded case of {command.method}: only CMIGNet's comes with the package")
    if command.dtype != "float64":
        raise ValueError(f"dtype = {command.dtype}: expected float64, in which the other methods are compared from end to end")
    method = METHODS[command.method]
    (case,) = read_cases(command.case, method.inputs, method.optional)
    state = _read_weights(command.weights) if command.weights else weights_of(method, case, command.seed)
    rows = check_method(method, case, state, command.kernels)
    print(f"{table(rows)}\n")
    print(summary(rows, lambda key: key.split("/")[0] if key.startswith(("grad_norm/", "buffer_sum/")) else "outputs"))
    return rows


def _read_weights(path: Path) -> State:
    from cmig_jax.parity.torch_files import read_torch

    return read_torch(path)


def _compare(command: Compare) -> list[Row]:
    from cmig_jax.models.cmignet.flags import released
    from cmig_jax.parity.cmignet_compare import compare_live
    from cmig_jax.parity.cmignet_layout import flags_of_state, layout, small, with_margins
    from cmig_jax.parity.inputs import random_inputs
    from cmig_jax.parity.torch_files import read_torch
    from cmig_jax.parity.weights import named_weights

    points, size, keypoints = (64, 32, 24) if command.size == "small" else (320, 64, 96)
    state = None if command.weights is None else read_torch(command.weights)
    flags = flags_of_state(state) if state is not None else small() if command.size == "small" else released()
    if state is None:
        flags = replace(flags, matching=replace(flags.matching, iterations=command.iterations or flags.matching.iterations))
    flags = replace(with_margins(flags, command.margins), keypoints=replace(flags.keypoints, count=command.keypoints or keypoints))
    inputs = random_inputs(command.seed, command.pairs, command.points or points, command.views, command.image_size or size)
    state = named_weights(layout(flags), command.seed) if state is None else state
    rows = sorted(compare_live(state, flags, inputs, command.seed, command.kernels), key=used, reverse=True)
    print(f"{table(rows[: command.show])}\n{max(len(rows) - command.show, 0)} more rows, further from their bounds\n")
    print(summary(rows, lambda key: key.split("/")[0]))
    return rows
