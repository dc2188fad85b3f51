"""The command line: `cmig COMMAND ...`. The scripts `train.py` and `evaluate.py` and the `python -m` forms call it too.

Exit codes of all commands: 0 done; 1 done, but something failed that the command checks (a loss that is not finite, a failed row, a
comparison beyond its bound); 2 bad input, explained in one line; 130 interrupted.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Sequence

from cmig_jax.commands import Failed, Stopped
from cmig_jax.cpu_memory import restart_with_jemalloc
from cmig_jax.experiments.schema import Catalogue

COMMANDS = {
    "register": "find the transform between two files",
    "train": "train a network",
    "evaluate": "evaluate a network beside methods without learning",
    "prepare": "sample and render objects ahead of time, or check a prepared folder",
    "export": "pack a trained network into one file",
    "experiments": "run the paper's tables and figures, and ours",
    "parity": "compare with the PyTorch reference, convert its weights",
    "bench": "measure speed and memory",
}
TRAINING = ("train", "experiments")
"""Commands that train; they run with jemalloc where it is installed, unless given --no-jemalloc."""


def main(arguments: Sequence[str], catalogue: Callable[[], Catalogue], prog: str | None = None, *, is_program: bool = False) -> int:
    """Run a command.

    Args:
        arguments: the command and its arguments.
        catalogue: returns presets and experiments.
        prog: what the user typed for the command; by default `cmig COMMAND`.
        is_program: this process does nothing else, and may be started again with another allocator.

    Returns:
        The exit code.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        print("usage: cmig COMMAND ...\n")
        print("\n".join(f"  {name:{width}}  {about}" for name, about in COMMANDS.items()))
        print("\ncmig COMMAND --help explains a command.")
        return 0
    name, *rest = arguments
    if name not in COMMANDS:
        return _error(f"{name}: expected a command: {', '.join(COMMANDS)}")
    if is_program and name in TRAINING and "--no-jemalloc" not in rest:
        restart_with_jemalloc()
    command = importlib.import_module(f"cmig_jax.commands.{name}")
    try:
        return command.run(command.parse(rest, prog or f"cmig {name}", catalogue))
    except BrokenPipeError:  # `cmig ... | head` closed the pipe; without this, Python prints an error when it flushes at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError) as error:
        return _error(error)
    except Failed as error:
        print(f"stopped: {error}", file=sys.stderr)
        return 1
    except Stopped as stopped:
        print(stopped, file=sys.stderr)
        return 130
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 130


def entry() -> int:
    """Run the console script `cmig`."""
    return main(sys.argv[1:], installed_catalogue, is_program=True)


def module_entry(name: str, module: str) -> int:
    """Run `python -m MODULE` as the command `name`."""
    return main([name, *sys.argv[1:]], installed_catalogue, f"python -m {module}", is_program=True)


def installed_catalogue() -> Catalogue:
    """Return the presets and experiments that are installed with the package (the folder `configs/` of the repository)."""
    try:
        from cmig_jax.presets.catalogue import catalogue  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:  # in a checkout that is not installed
        from configs.catalogue import catalogue

    return catalogue()


def _error(error: object) -> int:
    print(f"error: {error}", file=sys.stderr)
    return 2
