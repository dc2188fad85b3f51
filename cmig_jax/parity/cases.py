"""Recorded cases: inputs and outputs of a PyTorch network in one `.npz`, to hold another implementation to.

Arrays have PyTorch's layout (channels second). A run of a network is a dict of its results by name, with `gradient/<parameter>` and
`statistics/<buffer>` (after the step) in training mode. A case holds some of them whole and others as summaries: `<name>/stats` (mean,
population standard deviation, largest absolute value, sum of every 997th element), `<name>/head` (first 8 along the last axis),
`grad_norm/<parameter>` and `buffer_sum/<buffer>`. In a file of both modes, evaluation's keys start with `evaluation/`. Weights are not
recorded: see `weights.named_weights`.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray]
State = Mapping[str, NDArray]
EVALUATION = "evaluation/"
PACKED, NAMES = "packed", "packed_names"
"""Many outputs as one array, and the name and shape of each: an entry of an archive takes more room than a small output."""


@dataclass(frozen=True)
class Case:
    """The inputs of one pass of a network, and what was recorded of its results."""

    inputs: Arrays
    outputs: Arrays


def stats(value: NDArray) -> NDArray:
    """Return mean, population standard deviation, largest absolute value and the sum of every 997th element, `[4]`."""
    return np.array([value.mean(), value.std(), np.abs(value).max(), value.ravel()[::997].sum()])


BY_FORM: dict[str, Callable[[NDArray], NDArray]] = {"stats": stats, "head": lambda value: value[..., :8]}
BY_KIND: dict[str, tuple[str, Callable]] = {"grad_norm": ("gradient", np.linalg.norm), "buffer_sum": ("statistics", np.sum)}


def as_recorded(key: str, run: State) -> NDArray | None:
    """Return what a case stores under `key`, computed from the results of a run; None if they do not have it."""
    if key in run:
        return run[key]
    (kind, _, name), (whole, _, form) = key.partition("/"), key.rpartition("/")
    group, summary = BY_KIND.get(kind, (None, BY_FORM.get(form)))
    value = run.get(f"{group}/{name}" if group else whole)
    return None if value is None or summary is None else np.asarray(summary(value))


def read_cases(path: Path, inputs: Mapping[str, str], training_inputs: tuple[str, ...] = ()) -> list[Case]:
    """Read a case, or from a file of both modes training and then evaluation.

    Args:
        path: the file.
        inputs: names of the inputs and their axes, such as `B 3 N`; the same letter is the same length.
        training_inputs: those that evaluation has not.

    Raises:
        ValueError: not an `.npz` file, an input is missing or has another shape, or nothing is recorded.
    """
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = _unpacked({key: file[key] for key in file.files})
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: expected a recorded case (.npz): {error}") from error
    if missing := [name for name in inputs if name not in arrays and name not in training_inputs]:
        raise ValueError(f"{path}: expected a recorded case, but it has no {', '.join(missing)}")
    given = {name: arrays.pop(name) for name in inputs if name in arrays}
    _check_shapes(path, given, inputs)
    evaluation = {key.removeprefix(EVALUATION): arrays.pop(key) for key in [*arrays] if key.startswith(EVALUATION)}
    shared = {name: value for name, value in given.items() if name not in training_inputs}
    if cases := [Case(i, outputs) for i, outputs in ((given, arrays), (shared, evaluation)) if outputs]:
        return cases
    raise ValueError(f"{path}: expected a recorded case, but it has no outputs")


def _unpacked(arrays: Arrays) -> Arrays:
    if PACKED not in arrays:
        return arrays
    values = arrays.pop(PACKED)
    for entry in arrays.pop(NAMES):
        name, *axes = entry.decode().split()
        shape = tuple(map(int, axes))
        arrays[name], values = values[: np.prod(shape, dtype=int)].reshape(shape), values[np.prod(shape, dtype=int) :]
    return arrays


def _check_shapes(path: Path, arrays: Arrays, expected: Mapping[str, str]) -> None:
    lengths: dict[str, int] = {}
    for name, value in arrays.items():
        axes = expected[name].split()
        wanted = [int(axis) if axis.isdigit() else lengths.setdefault(axis, n) for axis, n in zip(axes, value.shape, strict=False)]
        if len(axes) != value.ndim or wanted != list(value.shape):
            raise ValueError(f"{path}: {name} has shape {value.shape}, expected [{', '.join(axes)}] with {lengths}")
