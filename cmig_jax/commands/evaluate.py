"""`cmig evaluate [RUN_FOLDER or FILE.npz] [flags]`."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cmig_jax.commands.parsing import parse_flags
from cmig_jax.config import ComputeConfig, Config, DataConfig, ModelFlags, ViewsConfig, is_inside, unchecked
from cmig_jax.experiments.schema import Catalogue


@dataclass(frozen=True)
class Command:
    """Evaluate a network on test pairs beside methods without learning; write results, tables and pictures."""

    data: DataConfig
    """Test data; by default as in training."""
    views: ViewsConfig
    """Its views."""
    model: ModelFlags
    """What can change without changing the weights, such as the number of keypoints."""
    compute: ComputeConfig
    """How it is computed."""
    network: Annotated[Path | None, tyro.conf.Positional] = None
    """Run folder or weights file; by default the network that comes with the package."""
    which: Literal["best", "last"] = "best"
    """Checkpoint of a run folder: the best on validation, or the last."""
    mask: Path | None = None
    """Run folder or weights file of a MaskNet, which then chooses the target's points that the network sees."""
    limit: int | None = None
    """Evaluate on this many test pairs, evenly spaced, instead of all."""
    batch: int = 16
    """Pairs per call of the network."""
    search: tuple[Literal["any", "bound"], ...] = ()
    """Rows of `register`, about a second a pair: `any` knows nothing about the rotation, `bound` its largest angle in the protocol."""
    out: str = "evaluation"
    """Name of the folder for the results, inside the run folder; for a weights file inside runs/NAME-weights."""
    report: bool = False
    """Also write the report, report.html: one page that opens without a server, with its figures as PNG beside it."""
    report_pairs: int = 20
    """Pairs to show in the report: the worst, and some down to the best."""


@dataclass(frozen=True)
class Parsed:
    """A command, the config that it starts from, and what was typed."""

    command: Command
    config: Config
    typed: str


def parse(arguments: Sequence[str], prog: str, catalogue: Callable[[], Catalogue]) -> Parsed:
    """Parse the flags twice: for the network, then with the network's own flags as their defaults, which only then can be checked."""
    from cmig_jax.inference.load import trained_config

    without_help = [argument for argument in arguments if argument not in ("-h", "--help")]
    any_config = next(iter(catalogue().presets.values()))()
    with unchecked():
        first, _ = parse_flags(Command, prog, without_help, default=_command(any_config), return_unknown_args=True)
    config = trained_config(first.network)
    command = parse_flags(Command, prog, arguments, default=_command(config))
    changed = {"data": command.data, "views": command.views, "model": command.model, "compute": command.compute}
    return Parsed(command, dataclasses.replace(config, **changed), shlex.join([*prog.split(), *arguments]))


def run(parsed: Parsed) -> int:
    """Evaluate, print the table, and draw.

    Raises:
        ValueError: no checkpoint, no test objects in the chosen categories, `report_pairs` or `batch` below 1, an `out` elsewhere.
    """
    from cmig_jax import baselines
    from cmig_jax.compilation import keep_compiled_programs
    from cmig_jax.evaluation.evaluate import evaluate_network
    from cmig_jax.evaluation.tables import text_table
    from cmig_jax.inference.load import load
    from cmig_jax.inference.masked import behind_mask
    from cmig_jax.inference.run_folder import is_validated
    from cmig_jax.inference.weights_file import PRETRAINED, SUFFIX
    from cmig_jax.report.write import draw, write_report

    command = parsed.command
    if command.report and command.report_pairs < 1:
        raise ValueError(f"report_pairs = {command.report_pairs}: expected at least 1 pair")
    if command.batch < 1:
        raise ValueError(f"batch = {command.batch}: expected at least 1 pair")
    if not is_inside(command.out) or Path(command.out).parts[0] in ("checkpoints", "tensorboard"):
        raise ValueError(f"out = {command.out!r}: expected the name of a new folder, or of one that results are in")
    keep_compiled_programs()
    path = command.network or PRETRAINED
    network, which, is_run = load(path, command.which, command.batch, config=parsed.config), command.which, path.suffix != SUFFIX
    if command.mask is not None:
        network = behind_mask(network, load(command.mask, command.which, command.batch))
    if is_run and which == "best" and not is_validated(path):
        print(f"{path}: none of its checkpoints was validated, so this is the last one, step {network.step}")
        which = "last"
    checkpoint = f"{which}, step {network.step}" if is_run else f"{path.name}, step {network.step}"
    name = path.resolve().name if is_run else path.stem
    folder = (path if is_run else Path("runs") / f"{name}-weights") / command.out
    evaluation = evaluate_network(
        network,
        folder,
        command=parsed.typed,
        checkpoint=checkpoint,
        limit=command.limit,
        batch=command.batch,
        search=command.search,
    )
    print(text_table(evaluation.results))
    draw(evaluation, path / "log.jsonl" if is_run else None)
    for row, reason in baselines.missing().items():
        print(f"without {row}: {reason}")
    if command.report:
        print(f"report: {write_report(evaluation, name, command.report_pairs)}")
    print(f"results and pictures are in {folder}")
    return 0


def _command(config: Config) -> Command:
    return Command(data=config.data, views=config.views, model=config.model, compute=config.compute)
