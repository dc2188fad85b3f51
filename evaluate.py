"""Evaluate a trained network beside the baselines: `python evaluate.py RUN_FOLDER [flags]`."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cmig_jax.compilation import keep_compiled_programs
from cmig_jax.config import ComputeConfig, Config, DataConfig, ModelConfig, ViewsConfig
from cmig_jax.report.testing import evaluate_run
from cmig_jax.training.checkpoint import read_config


@dataclass(frozen=True)
class Command:
    """Evaluate a run on the test split of its data; write results.json, errors.npz, tables and pictures into a folder of the run."""

    run: Annotated[Path, tyro.conf.Positional]
    """The run folder."""
    data: DataConfig
    """Test data; by default as in training."""
    views: ViewsConfig
    """Its views."""
    model: ModelConfig
    """What can change without changing the weights, such as the number of keypoints."""
    compute: ComputeConfig
    """How it is computed."""
    which: Literal["best", "last"] = "best"
    """Checkpoint: the best on validation, or the last."""
    limit: int | None = None
    """Evaluate on this many test pairs, evenly spaced, instead of all."""
    batch: int = 16
    """Pairs per call of the network."""
    out: str = "evaluation"
    """Name of the folder, inside the run folder, that the results go to."""
    report: bool = False
    """Also write the report, report.html: one page that opens without a server, with its figures as PNG beside it."""
    report_pairs: int = 20
    """Pairs to look at in the report: the worst, and some down to the best."""


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, evaluate, print the table, and return the exit code: 0, 2 for bad input, 130 when interrupted."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        command, config = parse(arguments)
        typed = shlex.join(["python", "evaluate.py", *arguments])
        evaluate_run(
            command.run,
            config,
            typed,
            which=command.which,
            limit=command.limit,
            batch=command.batch,
            out=command.out,
            report_pairs=command.report_pairs if command.report else None,
        )
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command continues", file=sys.stderr)
        return 130
    return 0


def parse(arguments: list[str]) -> tuple[Command, Config]:
    """Parse the flags twice: for the run folder, then with the run's own config as their defaults."""
    without_help = [argument for argument in arguments if argument not in ("-h", "--help")]
    default = _command(Path("RUN_FOLDER"), Config())
    run = tyro.cli(Command, args=without_help, default=default).run
    config = read_config(run) if run != default.run or arguments == without_help else Config()
    command = tyro.cli(Command, args=arguments, default=_command(run, config))
    changed = {"data": command.data, "views": command.views, "model": command.model, "compute": command.compute}
    return command, dataclasses.replace(config, **changed)


def _command(run: Path, config: Config) -> Command:
    return Command(run=run, data=config.data, views=config.views, model=config.model, compute=config.compute)


if __name__ == "__main__":
    keep_compiled_programs()
    raise SystemExit(main())
