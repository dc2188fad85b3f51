"""Train CMIGNet: `python train.py PRESET [flags]`."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cmig_jax.allocator import keep_freed_memory
from cmig_jax.compilation import keep_compiled_programs
from cmig_jax.config import Config
from cmig_jax.training.loop import Interrupted, NonFiniteLoss, train
from cmig_jax.training.processes import is_first, join
from configs import PRESETS


@dataclass(frozen=True)
class Command:
    """Train a network; the run folder RUNS/NAME then holds its config, checkpoints and logs."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    resume: bool = False
    """Continue the run folder where it stopped (or start, if there is none)."""
    runs: Path = Path("runs")
    """Folder of run folders."""
    devices: int | None = None
    """Devices to use; by default the most that divide the batch (of several processes: all)."""
    distributed: bool = False
    """Train as one of several processes, on one or more hosts; SLURM, Open MPI and TPU pods tell each process the three flags below."""
    coordinator: str | None = None
    """HOST:PORT where process 0 listens, any free port (with --distributed)."""
    processes: int | None = None
    """Number of processes (with --distributed)."""
    process: int | None = None
    """Which of the processes this is, from 0 (with --distributed)."""


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, train, return the exit code: 0, 1 for a loss that is not finite, 2 for bad input, 130 when interrupted."""
    try:
        command = parse(arguments)  # flags that exclude each other are found when the config is made, inside tyro
        _join(command)
        train(command.config, command.runs / command.config.name, resume=command.resume, devices=command.devices)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except NonFiniteLoss as error:
        _say(f"stopped: {error}")
        return 1
    except Interrupted as error:
        _say(str(error))
        return 130
    except KeyboardInterrupt:
        print("stopped at once; --resume continues from the last checkpoint", file=sys.stderr)
        return 130
    return 0


def parse(arguments: list[str] | None = None) -> Command:
    """Parse a command line: a preset and flags."""
    presets = {name: Command(config=preset()) for name, preset in PRESETS.items()}
    descriptions = {name: preset.__doc__ or "" for name, preset in PRESETS.items()}
    chosen = tyro.extras.subcommand_type_from_defaults(presets, descriptions)
    return tyro.cli(chosen, args=arguments, config=(tyro.conf.ConsolidateSubcommandArgs,))


def _join(command: Command) -> None:
    given = (command.coordinator, command.processes, command.process)
    if command.distributed:
        join(*given)
    elif given != (None, None, None):
        raise ValueError("--coordinator, --processes and --process are of --distributed: expected that flag too")


def _say(text: str) -> None:
    """Print what all processes know once."""
    if is_first():
        print(text, file=sys.stderr)


if __name__ == "__main__":
    keep_freed_memory()
    keep_compiled_programs()
    raise SystemExit(main())
