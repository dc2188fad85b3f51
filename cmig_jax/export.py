"""Pack the best checkpoint of a run folder into one weights file: `python -m cmig_jax.export RUN_FOLDER FILE.npz`."""

from __future__ import annotations

import sys
from pathlib import Path

import jax

from cmig_jax.registration import load
from cmig_jax.weights import write_weights


def main(arguments: list[str]) -> int:
    """Load, write, and return the exit code."""
    asked = arguments in (["-h"], ["--help"])
    if asked or len(arguments) != 2 or Path(arguments[1]).suffix != ".npz":
        print("usage: python -m cmig_jax.export RUN_FOLDER FILE.npz", file=sys.stdout if asked else sys.stderr)
        return 0 if asked else 2
    try:
        network = load(arguments[0])
        write_weights(Path(arguments[1]), network.config, network.step, jax.device_get(network.variables))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{arguments[1]}: the network of {arguments[0]} after {network.step} steps")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
