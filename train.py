"""Train CMIGNet: `python train.py PRESET [flags]`."""

from __future__ import annotations

import sys
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


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, train, return the exit code: 0, 1 for a loss that is not finite, 2 for bad input, 130 when interrupted."""
    presets = {name: Command(config=preset()) for name, preset in PRESETS.items()}
    descriptions = {name: preset.__doc__ or "" for name, preset in PRESETS.items()}
    chosen = tyro.extras.subcommand_type_from_defaults(presets, descriptions)
    try:
        # Flags that exclude each other are found when the config is made, inside tyro.
        command: Command = tyro.cli(chosen, args=arguments, config=(tyro.conf.ConsolidateSubcommandArgs,))
        train(command.config, command.runs / command.config.name, resume=command.resume, devices=command.devices)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except NonFiniteLoss as error:
        print(f"stopped: {error}", file=sys.stderr)
        return 1
    except Interrupted as error:
        print(error, file=sys.stderr)
        return 130
    except KeyboardInterrupt:
        print("stopped at once; --resume continues from the last checkpoint", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
