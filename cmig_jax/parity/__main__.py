"""`python -m cmig_jax.parity`: the same as `cmig parity`."""

from cmig_jax.cli import module_entry

if __name__ == "__main__":
    raise SystemExit(module_entry("parity", "cmig_jax.parity"))
