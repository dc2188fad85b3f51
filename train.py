"""Train a network: `python train.py PRESET [flags]`, the same as `cmig train`."""

import sys

from cmig_jax.cli import main
from configs.catalogue import catalogue

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]], catalogue, "python train.py", is_program=True))
