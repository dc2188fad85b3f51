"""`python -m cmig_jax.align` is `cmig register`."""

import sys

from cmig_jax.cli import module_entry

if __name__ == "__main__":
    sys.exit(module_entry("register", "cmig_jax.align"))
