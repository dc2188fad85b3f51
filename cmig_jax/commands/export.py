"""`cmig export RUN_FOLDER FILE.npz`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from cmig_jax.commands.parsing import parser_of


@dataclass(frozen=True)
class Command:
    """Pack a checkpoint of a run folder into one weights file, in half precision; `load` reads it."""

    run: Positional[Path]
    """The run folder."""
    file: Positional[Path]
    """The weights file to write, FILE.npz."""
    which: Literal["best", "last"] = "best"
    """Checkpoint: the best on validation, or the last."""


parse = parser_of(Command)


def run(command: Command) -> int:
    """Load, and write.

    Raises:
        ValueError: no such run, no checkpoint in it, or a file that does not end in .npz.
    """
    import jax

    from cmig_jax.inference.load import load
    from cmig_jax.inference.weights_file import SUFFIX, write_weights

    if command.file.suffix != SUFFIX:
        raise ValueError(f"{command.file}: expected a file name that ends in {SUFFIX}")
    network = load(command.run, command.which)
    write_weights(command.file, network.config, network.step, jax.device_get(network.variables))
    print(f"{command.file}: the network of {command.run} after {network.step} steps")
    return 0
