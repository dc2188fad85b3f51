"""Evaluate a network beside methods without learning: `python evaluate.py RUN_FOLDER [flags]`, the same as `cmig evaluate`."""

import sys

from cmig_jax.cli import main
from configs.catalogue import catalogue

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]], catalogue, "python evaluate.py", is_program=True))
