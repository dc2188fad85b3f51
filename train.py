"""Train CMIGNet: `python train.py PRESET [flags]`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cmig_jax.config import Config
from cmig_jax.training.loop import Interrupted, NonFiniteLoss, train
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
    """Devices to use; by default the most that divide the batch."""


def main(command: Command) -> int:
    """Run a command and return its exit code."""
    config = command.config
    try:
        train(config, command.runs / config.name, resume=command.resume, devices=command.devices)
    except ValueError as error:
        print(f"error: {error}")
        return 2
    except NonFiniteLoss as error:
        print(f"stopped: {error}")
        return 1
    except Interrupted as error:
        print(error)
        return 130
    return 0


if __name__ == "__main__":
    presets = {name: Command(config=preset()) for name, preset in PRESETS.items()}
    descriptions = {name: preset.__doc__ or "" for name, preset in PRESETS.items()}
    chosen = tyro.extras.subcommand_type_from_defaults(presets, descriptions)
    raise SystemExit(main(tyro.cli(chosen, config=(tyro.conf.ConsolidateSubcommandArgs,))))
