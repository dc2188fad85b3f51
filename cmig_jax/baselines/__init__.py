"""Registration without learning, to compare networks with (Sec. IV-A).

`classical` lists the methods. `local` has those that need a start (ICP, generalised ICP; `refine` starts them from a network's pose),
`fpfh` and `kiss` have the global ones of the extra `[baselines]`. `missing` lists those that are not installed, and how to install them.
Every method takes a source `[N, 3]` and a target `[M, 3]` and returns `target_from_source`, NumPy float64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cmig_jax.baselines.fpfh import FastGlobal, FpfhRansac, load_open3d
from cmig_jax.baselines.kiss import KissMatcher, load_kiss_matcher
from cmig_jax.baselines.local import ICP_CUTOFF, ICP_TUNED, Gicp, Icp, Identity, gicp, icp
from cmig_jax.baselines.method import Baseline
from cmig_jax.baselines.refine import CUTOFFS, refine_by_gicp, refine_by_icp
from cmig_jax.config import DataConfig
from cmig_jax.data.protocol import mean_angle_deg

__all__ = [
    "CUTOFFS",
    "ICP_CUTOFF",
    "ICP_TUNED",
    "Baseline",
    "FastGlobal",
    "FpfhRansac",
    "Gicp",
    "Icp",
    "Identity",
    "KissMatcher",
    "classical",
    "gicp",
    "icp",
    "missing",
    "refine_by_gicp",
    "refine_by_icp",
]

INSTALL = "pip install 'cmig_jax[baselines]'"


def classical(data: DataConfig) -> dict[str, Baseline]:
    """Return the methods without learning by the names of their rows; those of the extra only if it can be imported.

    Args:
        data: flags of the protocol; the row "ICP (mean pose)" starts from its mean rotation.
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
    """Return the rows that `classical` leaves out, each with the reason and the command that installs its package."""
    reasons = {name: _obstacle(load) for name, (_, load) in _extra().items()}
    return {name: reason for name, reason in reasons.items() if reason is not None}


def _extra() -> dict[str, tuple[Baseline, Callable[[], Any]]]:
    return {
        "FPFH + RANSAC": (FpfhRansac(), load_open3d),
        "FGR": (FastGlobal(), load_open3d),
        "KISS-Matcher": (KissMatcher(), load_kiss_matcher),
    }


def _obstacle(load: Callable[[], Any]) -> str | None:
    """Return the reason why a package cannot be imported, or None."""
    try:
        load()
    except ModuleNotFoundError as error:
        return f"{error}: {INSTALL}"
    except (ImportError, OSError) as error:  # the package is installed, but a system library that it needs is not
        return f"{error}: {INSTALL}, and install that library (libusb-1.0.so.0 is Debian's and Ubuntu's package libusb-1.0-0)"
    return None
