"""Registration without learning, to compare the network with (Sec. IV-A), every method with the settings it runs with.

`classical` lists the methods: `local` has those that need a start (ICP, generalised ICP; `finish` has them from the pose of a network),
`fpfh` and `kiss` the global ones, which come with the extra `[baselines]`; `missing` says which are not there, and what brings them.
Every method takes a source `[N, 3]` and a target `[M, 3]` and returns `target_from_source`: R `[3, 3]`, t `[3]`, float64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cmig_jax.baselines.finish import CUTOFFS, finish_by_gicp, finish_by_icp
from cmig_jax.baselines.fpfh import FastGlobal, FpfhRansac, load_open3d
from cmig_jax.baselines.kiss import KissMatcher, load_kiss_matcher
from cmig_jax.baselines.local import (
    ICP_CUTOFF,
    ICP_TUNED,
    Gicp,
    Icp,
    Identity,
    gicp,
    icp,
    icp_cutoff,
    icp_tuned,
    identity,
)
from cmig_jax.baselines.method import Baseline, Pose
from cmig_jax.config import DataConfig
from cmig_jax.data.pairs import mean_angle_deg

__all__ = [
    "CUTOFFS",
    "Baseline",
    "FastGlobal",
    "FpfhRansac",
    "Gicp",
    "Icp",
    "Identity",
    "KissMatcher",
    "Pose",
    "classical",
    "finish_by_gicp",
    "finish_by_icp",
    "gicp",
    "icp",
    "icp_cutoff",
    "icp_tuned",
    "identity",
    "missing",
]

INSTALL = "pip install -e '.[baselines]'"


def classical(data: DataConfig) -> dict[str, Baseline]:
    """Return the methods without learning by the name of their row: the core's, and those of the extra that can be imported.

    Args:
        data: the protocol, whose mean rotation the row "ICP (mean pose)" is told.
    """
    rows: dict[str, Baseline] = {
        "identity": Identity(),
        "ICP (cutoff 0.02)": ICP_CUTOFF,
        "ICP (tuned)": ICP_TUNED,
        "ICP (mean pose)": Icp(start_angle_deg=mean_angle_deg(data)),
        "GICP": Gicp(),
    }
    absent = missing()
    return rows | {name: method for name, (method, _) in _extra().items() if name not in absent}


def missing() -> dict[str, str]:
    """Return the rows that `classical` cannot make, each with the reason and the command that brings it."""
    reasons = {name: _obstacle(load) for name, (_, load) in _extra().items()}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def _extra() -> dict[str, tuple[Baseline, Callable[[], Any]]]:
    return {
        "FPFH + RANSAC": (FpfhRansac(), load_open3d),
        "FGR": (FastGlobal(), load_open3d),
        "KISS-Matcher": (KissMatcher(), load_kiss_matcher),
    }


def _obstacle(load: Callable[[], Any]) -> str | None:
    """Say what keeps a package from being imported, or None."""
    try:
        load()
    except ModuleNotFoundError as error:
        return f"{error}: {INSTALL}"
    except (ImportError, OSError) as error:  # it is there, but a library of the system is not
        return f"{error}: {INSTALL}, and install that library (libusb-1.0.so.0 is Debian's and Ubuntu's package libusb-1.0-0)"
    return None
