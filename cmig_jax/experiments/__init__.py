"""The paper's tables and figures, and ours, as commands: `cmig experiments list | run NAME...`.

`configs/experiments.py` describes them with the classes of `schema`; `plan` turns a row into configs and command lines, `run` trains what
is missing and evaluates, `table` and `figure` write the results.
"""
