"""The paper's tables and figures, and ours, as commands: `python -m cmig_jax.experiments list | run NAME...`.

`configs/experiments.py` says what they are; `plan` turns a row into configs and command lines, `run` trains what is missing and
evaluates, `table` writes what came out.
"""
