"""`python -m cmig_jax.bench` is `cmig bench`."""

import sys

from cmig_jax.cli import module_entry

if __name__ == "__main__":
    sys.exit(module_entry("bench", "cmig_jax.bench"))
