"""The errors of an evaluation, pair by pair, as figures and pages read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Estimates:
    """The poses that one method estimated for n pairs, target_from_source.

    Attributes:
        R: `[n, 3, 3]`.
        t: `[n, 3]`, object units.
        rotation_deg: `[n]` isotropic rotation errors.
        shift: `[n]` isotropic translation errors, object units.
    """

    R: Floats
    t: Floats
    rotation_deg: Floats
    shift: Floats


@dataclass(frozen=True)
class Errors:
    """Every method on n pairs.

    Attributes:
        methods: by name, in the order of the table.
        network: name of the network's row, which figures highlight.
        R: `[n, 3, 3]` true rotations.
        t: `[n, 3]` true translations.
        angle_deg: `[n]` angles of the true rotations.
        overlap: `[n]` shares, see `data.overlap`.
        category: n names.
    """

    methods: Mapping[str, Estimates]
    network: str
    R: Floats
    t: Floats
    angle_deg: Floats
    overlap: Floats
    category: Sequence[str]

    def __len__(self) -> int:
        return len(self.angle_deg)


def read_errors(path: Path, *, network: str, categories: Sequence[str]) -> Errors:
    """Read `errors.npz` of an evaluation.

    Args:
        path: the file.
        network: name of the network's row.
        categories: names by label; a pair without a label has the name "".

    Raises:
        ValueError: the file has no such row.
    """
    with np.load(path) as file:
        arrays: dict[str, NDArray[Any]] = {key: file[key] for key in file.files}
    names = [key.removesuffix("/R") for key in arrays if key.endswith("/R")]
    if network not in names:
        raise ValueError(f"{path}: expected a row {network}, found {', '.join(names)}")
    return Errors(
        methods={n: Estimates(arrays[f"{n}/R"], arrays[f"{n}/t"], arrays[f"{n}/iso_r_deg"], arrays[f"{n}/iso_t"]) for n in names},
        network=network,
        R=arrays["R_true"],
        t=arrays["t_true"],
        angle_deg=arrays["angle_deg"],
        overlap=arrays["overlap"],
        category=[str(categories[label]) if label >= 0 else "" for label in arrays["label"]],
    )
