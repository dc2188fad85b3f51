"""What an evaluation measured, pair by pair, as the figures and the page read it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """The poses that one method found for n pairs, target_from_source.

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
        network: the name of the network's method; what others are judged beside.
        R: `[n, 3, 3]` true rotations.
        t: `[n, 3]` true translations.
        angle_deg: `[n]` angles of the true rotations.
        overlap: `[n]` shares, see `overlap.overlap`.
        category: n names.
        index: `[n]` of the pair's object in its data set.
    """

    methods: Mapping[str, Found]
    network: str
    R: Floats
    t: Floats
    angle_deg: Floats
    overlap: Floats
    category: Sequence[str]
    index: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.angle_deg)


def read_errors(path: Path, *, network: str, overlap: ArrayLike, categories: Sequence[str]) -> Errors:
    """Read `errors.npz` of an evaluation.

    Args:
        path: the file.
        network: the name of the network's method.
        overlap: `[n]` of the same pairs, in the same order.
        categories: names by label; a pair without a label has the name "".

    Raises:
        ValueError: the file has no such method, or another number of pairs than `overlap`.
    """
    with np.load(path) as file:
        arrays: dict[str, NDArray[Any]] = {key: file[key] for key in file.files}
    names = [key.removesuffix("/R") for key in arrays if key.endswith("/R")]
    shares = np.asarray(overlap, np.float64)
    if network not in names or shares.shape != arrays["index"].shape:
        expected = f"{network} and {len(shares)} pairs"
        raise ValueError(f"{path}: expected {expected}, found {', '.join(names)} and {len(arrays['index'])} pairs")
    return Errors(
        methods={n: Found(arrays[f"{n}/R"], arrays[f"{n}/t"], arrays[f"{n}/iso_r_deg"], arrays[f"{n}/iso_t"]) for n in names},
        network=network,
        R=arrays["R_true"],
        t=arrays["t_true"],
        angle_deg=arrays["angle_deg"],
        overlap=shares,
        category=[str(categories[label]) if label >= 0 else "" for label in arrays["label"]],
        index=arrays["index"],
    )
