"""What `register_sequence` returns: a pose per scan, the registrations behind them, and the merged cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from cmig_jax.clouds import thinned
from cmig_jax.transform import RigidTransform

Floats = NDArray[np.float64]
SPACING_POINTS = 2_000
"""Points of a cloud whose distance to the next one is measured."""


@dataclass(frozen=True)
class PairOfScans:
    """A registration of two scans, or of two groups of scans.

    Attributes:
        source, target: numbers of the scans; the frame of a group is that of its first.
        target_from_source: NumPy float64.
        trusted, confidence, overlap, inlier_rmse: as of `Registration`.
        used: whether the poses rest on it: it is trusted, or it agrees with those that are, and it does not contradict these.
        why: one sentence on `used`.
    """

    source: tuple[int, ...]
    target: tuple[int, ...]
    target_from_source: RigidTransform
    trusted: bool
    confidence: float
    overlap: tuple[float, float]
    inlier_rmse: float
    used: bool
    why: str


@dataclass(frozen=True)
class Scan:
    """What is known of one scan.

    Attributes:
        name: as it was given.
        pose: first_from_scan, NumPy float64; None if nothing trusted connects the scan to the first.
        group: lowest number of the scans that it is connected to; 0 for those of the first.
        confidence: the smallest confidence of the registrations that lead to the first scan, or to that of its group.
        why: one sentence.
    """

    name: str
    pose: RigidTransform | None
    group: int
    confidence: float
    why: str


@dataclass(frozen=True)
class ScanSequence:
    """All scans in the frame of the first, and the registrations behind that."""

    scans: tuple[Scan, ...]
    pairs: tuple[PairOfScans, ...]

    @property
    def trusted(self) -> bool:
        """Whether every scan has a pose."""
        return all(scan.pose is not None for scan in self.scans)

    def __str__(self) -> str:
        """Describe each scan in a line."""
        lines = [f"{scan.name}: {scan.why}" for scan in self.scans]
        groups = [scan.group for scan in self.scans]
        largest = max(groups, key=groups.count)
        if groups.count(0) < groups.count(largest):
            lines.append(f"{groups.count(largest)} scans fit each other and not the first: give {self.scans[largest].name} first")
        used = sum(pair.used for pair in self.pairs)
        return "\n".join([*lines, f"{groups.count(0)} of {len(groups)} scans in one frame, by {used} of {len(self.pairs)} registrations"])

    def merged(self, clouds: Sequence[Floats], cell: float | None = None) -> Floats:
        """Return the scans that have a pose as one cloud `[n, 3]` in the frame of the first, thinned on a grid (`merge`).

        Args:
            clouds: `[N, 3]` each, finite, in the order of the scans.
            cell: edge of the grid's cells, in the unit of the clouds.
        """
        moved = [scan.pose.apply(np.asarray(cloud, float)) for scan, cloud in zip(self.scans, clouds, strict=True) if scan.pose is not None]
        return merge(moved, cell)


def merge(tables: Sequence[Floats], cell: float | None = None) -> Floats:
    """Merge clouds of one frame: the rows of each cell of a grid become their mean.

    Args:
        tables: `[N, C]` each, finite: x y z, then other columns.
        cell: edge of a cell; by default the median over the clouds of the distance from a point to the next one.

    Returns:
        `[n, C]`, sorted by cell.
    """
    cell = float(np.median([_spacing(table[:, :3]) for table in tables])) if cell is None else cell
    corner = np.min([table[:, :3].min(axis=0) for table in tables], axis=0)
    return _thinned(np.concatenate([_thinned(table, corner, cell) for table in tables]), corner, cell)


def _thinned(table: Floats, corner: Floats, cell: float) -> Floats:
    cells = np.floor((table[:, :3] - corner) / cell).astype(np.int64)
    row = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    count = np.bincount(row)
    return np.stack([np.bincount(row, column) / count for column in table.T], axis=1)


def _spacing(points: Floats) -> float:
    """Return the median distance from a point to the nearest different one."""
    points = np.unique(points, axis=0)
    return float(np.median(KDTree(points).query(thinned(points, SPACING_POINTS), k=2)[0][:, 1]))
