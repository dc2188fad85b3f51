"""Recorded cases cut down for the tests: what is small is kept, of the rest the summaries."""

from pathlib import Path

import numpy as np

from cmig_jax.files import replacing
from cmig_jax.parity.cases import NAMES, PACKED, Arrays, Case, stats
from cmig_jax.parity.method import Method

MOST_NUMBERS = 32


def cut(method: Method, case: Case) -> Arrays:
    """Keep of a case's outputs what was chosen and what is small, and of the others `stats`; every element takes part in those."""
    kept: Arrays = {}
    for key, value in case.outputs.items():
        if value.size <= MOST_NUMBERS or value.dtype.kind != "f":
            kept[key] = value
        elif not key.endswith("/head"):
            kept[f"{key}/stats"] = stats(value)
    return kept


def write_cut(path: Path, method: Method, case: Case) -> None:
    """Write a cut case."""
    outputs = cut(method, case)
    names = np.array([" ".join([name, *map(str, np.shape(value))]) for name, value in outputs.items()])
    packed = np.concatenate([np.ravel(value).astype(np.float64) for value in outputs.values()])
    with replacing(path) as file:
        np.savez_compressed(file, **case.inputs, **{PACKED: packed, NAMES: names.astype("S")})
