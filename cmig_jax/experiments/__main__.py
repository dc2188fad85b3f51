"""`python -m cmig_jax.experiments` is `cmig experiments`."""

import sys

from cmig_jax.cli import module_entry

if __name__ == "__main__":
    sys.exit(module_entry("experiments", "cmig_jax.experiments"))
