"""`python -m cmig_jax.export` is `cmig export`."""

import sys

from cmig_jax.cli import module_entry

if __name__ == "__main__":
    sys.exit(module_entry("export", "cmig_jax.export"))
