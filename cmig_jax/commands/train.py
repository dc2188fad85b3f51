"""`cmig train PRESET [flags]`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cmig_jax.commands import Failed, Stopped
from cmig_jax.commands.parsing import parse_flags
from cmig_jax.config import Config
from cmig_jax.experiments.schema import Catalogue


@dataclass(frozen=True)
class Command:
    """Train a network; the run folder RUNS/NAME then holds its config, checkpoints and logs."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    resume: bool = False
    """Continue the run folder where it stopped (or start, if there is none)."""
    runs: Path = Path("runs")
    """Folder of run folders."""
    devices: int | None = None
    """Devices to use; by default the most that divide the batch (with several processes: all)."""
    jemalloc: bool = True
    """Use the memory allocator jemalloc, if it is installed (`cmig_jax/cpu_memory.py`)."""
    distributed: bool = False
    """Train as one of several processes, on one or more hosts; SLURM, Open MPI and TPU pods tell each process the three flags below."""
    coordinator: str | None = None
    """HOST:PORT where process 0 listens, any free port (with --distributed)."""
    processes: int | None = None
    """Number of processes (with --distributed)."""
    process: int | None = None
    """Which of the processes this is, from 0 (with --distributed)."""


def parse(arguments: Sequence[str], prog: str, catalogue: Callable[[], Catalogue]) -> Command:
    """Parse a preset and flags."""
    presets = catalogue().presets
    commands = {name: Command(config=preset()) for name, preset in presets.items()}
    descriptions = {name: preset.__doc__ or "" for name, preset in presets.items()}
    chosen = tyro.extras.subcommand_type_from_defaults(commands, descriptions)
    return parse_flags(chosen, prog, arguments, config=(tyro.conf.ConsolidateSubcommandArgs,))


def run(command: Command) -> int:
    """Train.

    Raises:
        Failed: a loss that is not finite.
        Stopped: the run was interrupted and saved.
    """
    from cmig_jax.compilation import keep_compiled_programs
    from cmig_jax.training.loop import Interrupted, NonFiniteLoss, train
    from cmig_jax.training.processes import is_first, join

    keep_compiled_programs()
    given = (command.coordinator, command.processes, command.process)
    if command.distributed:
        join(*given)
    elif given != (None, None, None):
        raise ValueError("--coordinator, --processes and --process belong to --distributed: expected that flag too")
    try:
        train(command.config, command.runs / command.config.name, resume=command.resume, devices=command.devices)
    except (NonFiniteLoss, Interrupted) as error:
        if not is_first():  # the first process prints what all of them know
            return 1 if isinstance(error, NonFiniteLoss) else 130
        raise (Failed if isinstance(error, NonFiniteLoss) else Stopped)(error) from error
    except KeyboardInterrupt as error:
        raise Stopped("stopped at once; --resume continues from the last checkpoint") from error
    return 0
