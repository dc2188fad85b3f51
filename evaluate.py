"""Evaluate a trained network beside the baselines: `python evaluate.py RUN_FOLDER [flags]`."""

from __future__ import annotations

import dataclasses
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cmig_jax.config import Config, DataConfig
from cmig_jax.report.testing import evaluate_run
from cmig_jax.training.checkpoint import read_config


@dataclass(frozen=True)
class Command:
    """Evaluate a run on the test split of its data; write results.json, errors.npz and pictures into a folder of the run."""

    run: Annotated[Path, tyro.conf.Positional]
    """The run folder."""
    data: DataConfig
    """Test data; by default as in training."""
    which: Literal["best", "last"] = "best"
    """Checkpoint: the best on validation, or the last."""
    limit: int | None = None
    """Evaluate on this many test pairs, evenly spaced, instead of all."""
    batch: int = 16
    """Pairs per call of the network."""
    out: str = "evaluation"
    """Name of the folder, inside the run folder, that the results go to."""


def main() -> int:
    """Parse the command line, evaluate, print the table."""
    arguments = sys.argv[1:]
    try:
        # The run's own config gives the defaults of the data flags.
        config = read_config(Path(arguments[0])) if arguments and not arguments[0].startswith("-") else Config()
        command = tyro.cli(Command, default=Command(run=Path("RUN_FOLDER"), data=config.data))
        config = dataclasses.replace(config, data=command.data)
        typed = shlex.join(["python", "evaluate.py", *arguments])
        evaluate_run(command.run, config, typed, which=command.which, limit=command.limit, batch=command.batch, out=command.out)
    except ValueError as error:
        print(f"error: {error}")
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command continues")
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
