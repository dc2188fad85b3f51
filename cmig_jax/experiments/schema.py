"""What an experiment is: a protocol and rows, as data (`configs/experiments.py`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from cmig_jax.config import Config

Flags = Mapping[str, Any]


@dataclass(frozen=True)
class Quoted:
    """What the paper prints for a row."""

    rmse_r_deg: float
    mae_r_deg: float
    rmse_t: float
    mae_t: float


@dataclass(frozen=True)
class Row:
    """One row of a table, or one point of a curve.

    Attributes:
        label: name in the table.
        preset: what the row starts from; None for a method that cannot be run.
        flags: what it changes in training and test.
        test: what it changes at test only.
        then: refinement at test, by point-to-point or generalised ICP.
        quoted: the paper's figures.
        absent: why there is nothing to run.
    """

    label: str
    preset: str | None
    flags: Flags = field(default_factory=dict)
    test: Flags = field(default_factory=dict)
    then: Literal["ICP", "GICP"] | None = None
    quoted: Quoted | None = None
    absent: str = ""


@dataclass(frozen=True)
class Experiment:
    """A table or figure.

    Attributes:
        about: what it asks, in one line.
        protocol: data flags of all its rows.
        rows: the rows.
        baselines: whether methods without learning stand beside the rows.
        columns: metrics that its table shows, keys of columns of `evaluation.tables`.
        drawn: the two of them that its picture shows.
    """

    about: str
    protocol: Flags
    rows: tuple[Row, ...]
    baselines: bool = False
    columns: tuple[str, ...] = ("rmse_r_deg", "mae_r_deg", "rmse_t", "mae_t", "recall", "seconds_per_pair")
    drawn: tuple[str, str] = ("rmse_r_deg", "mae_r_deg")


@dataclass(frozen=True)
class Catalogue:
    """What experiments are made of; the command line hands it in.

    Attributes:
        presets: functions that return a config, by name.
        scales: functions that change the size of a config, by name; `full` changes nothing.
        experiments: by name.
    """

    presets: Mapping[str, Callable[[], Config]]
    scales: Mapping[str, Callable[[Config], Config]]
    experiments: Mapping[str, Experiment]
