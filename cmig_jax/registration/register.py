"""Two clouds of a user's own in, their registration out."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from cmig_jax.registration import search, verdict
from cmig_jax.registration.clouds import UserCloud, user_cloud
from cmig_jax.registration.fit import fit
from cmig_jax.registration.levels import Level, grid_means
from cmig_jax.registration.result import Registration
from cmig_jax.transform import RigidTransform, check_transform

Floats = NDArray[np.float64]
COARSE_POINTS, FINE_POINTS, MOST_POINTS = 250, 1_200, 100_000
NEAR_DEG = 25.0
"""How far around a given start rotations are tried."""
MOST_ALTERNATIVES = 8
MOST_SHARED = 10_000
"""Larger clouds are not expected to share their points."""
LAST_CUTOFF, SPACINGS, LAST_ITERATIONS = 0.05, 3.0, 30
"""Cutoff of the last refinement: so many spacings of the clouds, at most `LAST_CUTOFF`."""


def register(
    source: Any,
    target: Any,
    network: Any = None,
    *,
    init: RigidTransform | None = None,
    rotations: Literal["any"] | float = "any",
    refine: bool = True,
    invalid: Literal["error", "drop"] = "error",
) -> Registration:
    """Find the rigid transform that takes one cloud onto another, and say whether it can be trusted.

    The clouds may differ in size and density and may overlap in part. Generalised ICP starts from many rotations about the clouds'
    centres on few points; the poses that fit best are refined on more points, and the best of them on up to `MOST_POINTS`. The result
    is a function of the clouds alone, without chance, and not of the order of their rows (above `clouds.SORTED_UP_TO` rows up to rounding).

    Args:
        source: `[N, 3]` real numbers, or an object with `points` or `vertices`, in any unit.
        target: `[M, 3]`, in the same unit.
        network: of `load`, or its run folder or weights file: its pose is one more start.
        init: a pose near the right one: only rotations within `NEAR_DEG` of it are tried.
        rotations: largest angle of the rotation in degrees, if it is known: fewer starts, and fewer poses to mistake for the right one.
        refine: without it, return the pose of the network as it is.
        invalid: `drop` leaves out rows that are not finite.

    Returns:
        The pose, NumPy float64, in the unit of the clouds, with its verdict.

    Raises:
        ValueError: a cloud that is not `[N, 3]` numbers, not finite, with fewer than `clouds.FEWEST` different points or all points on one
            line; a network that does not fit the clouds; an argument out of range.
    """
    limit = _checked_limit(rotations)
    if not refine and network is None:
        raise ValueError("refine = False: expected a network, whose pose is then returned as it is")
    clock = _Clock()
    frame = _Frame(user_cloud(source, "source", invalid), user_cloud(target, "target", invalid))
    dense, fine, coarse = frame.levels((MOST_POINTS, FINE_POINTS, COARSE_POINTS))
    clock.stage("clouds")
    starts = [] if network is None else [frame.normalised(_pose_of_network(network, frame))]
    clock.stage("network")
    if refine:
        starts += _starts(limit, None if init is None else frame.normalised(init))
        candidates = search.find(coarse, fine, starts, limit if init is None else 180.0)
        clock.stage("search")
        best, information = _refined(dense, fine, candidates[0])
    else:
        candidates = [search.Candidate(starts[0], fit(*fine, starts[0]))]
        best, information = starts[0], np.zeros((6, 6))
    pairs = _correspondences(frame, best)
    clock.stage("refinement")
    measured = fit(*fine, best)
    found = verdict.features([measured.cost, *(c.fit.cost for c in candidates[1:])], [c.starts for c in candidates], measured.overlap)
    confidence = verdict.confidence(found)
    close = [c for c in candidates[1:] if c.fit.cost < measured.cost + verdict.CLOSE]
    return Registration(
        target_from_source=frame.original(best),
        trusted=confidence >= verdict.TRUSTED,
        why=verdict.explain(found, frame.ratio),
        confidence=confidence,
        overlap=measured.overlap,
        inlier_rmse=measured.rmse * frame.scale,
        correspondences=pairs,
        information=information,
        alternatives=tuple(frame.original(c.matrix) for c in close[:MOST_ALTERNATIVES]),
        dropped=(frame.source.dropped, frame.target.dropped),
        seconds=clock.seconds,
    )


@dataclass(frozen=True)
class _Frame:
    """Both clouds, and the normalised frame: each at its own centre, the larger of radius 1."""

    source: UserCloud
    target: UserCloud

    @property
    def scale(self) -> float:
        return max(self.source.radius, self.target.radius)

    @property
    def ratio(self) -> float:
        return self.scale / min(self.source.radius, self.target.radius)

    def normalised_clouds(self) -> tuple[Floats, Floats]:
        source, target = ((cloud.points - cloud.centre) / self.scale for cloud in (self.source, self.target))
        return source, target

    def levels(self, counts: Sequence[int]) -> list[tuple[Level, Level]]:
        """Return both clouds with at most so many points, each level thinned from the one before."""
        clouds, radii = self.normalised_clouds(), (self.source.radius / self.scale, self.target.radius / self.scale)
        levels = []
        for count in counts:
            clouds = tuple(grid_means(cloud, count, radius) for cloud, radius in zip(clouds, radii, strict=True))
            levels.append((Level(clouds[0]), Level(clouds[1])))
        return levels

    def normalised(self, pose: RigidTransform) -> Floats:
        R, t = np.asarray(pose.R, np.float64), np.asarray(pose.t, np.float64)
        return _matrix(R, (R @ self.source.centre + t - self.target.centre) / self.scale)

    def original(self, matrix: Floats) -> RigidTransform:
        R, t = matrix[:3, :3], matrix[:3, 3]
        return check_transform(R, self.target.centre + self.scale * t - R @ self.source.centre, "register")


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stage(self, name: str) -> None:
        """End a stage."""
        now = time.perf_counter()
        self.seconds[name], self._last = now - self._last, now


def _checked_limit(rotations: Literal["any"] | float) -> float:
    if rotations == "any":
        return 180.0
    if isinstance(rotations, str) or not 0 <= rotations <= 180:
        raise ValueError(f"rotations = {rotations!r}: expected any, or an angle of 0 to 180 degrees")
    return float(rotations)


def _starts(limit: float, init: Floats | None) -> Sequence[Floats]:
    if init is None:
        return [_matrix(R, np.zeros(3)) for R in search.rotations(limit)]
    return [_matrix(R @ init[:3, :3], init[:3, 3]) for R in search.rotations(min(limit, NEAR_DEG))]


def _matrix(R: Floats, t: Floats) -> Floats:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t
    return matrix


def _pose_of_network(network: Any, frame: _Frame) -> RigidTransform:
    from cmig_jax.inference.load import Network, load
    from cmig_jax.registration.network import network_pose

    found = load(network) if isinstance(network, (str, Path)) else network
    if not isinstance(found, Network):
        raise ValueError(f"network = {found!r}: expected what `load` returns, a run folder or a weights file")
    return network_pose(found, frame.source.points, frame.target.points)


def _refined(dense: tuple[Level, Level], fine: tuple[Level, Level], candidate: search.Candidate) -> tuple[Floats, Floats]:
    """Refine the best pose on all points; keep it as it was if that fits worse.

    Clouds that share most of their points fit better by point-to-point ICP: most partners are then at less than half the distance.
    """
    spacing = max(level.spacing for level in dense)
    rounds = [(min(LAST_CUTOFF, SPACINGS * spacing), LAST_ITERATIONS)]
    threads = os.cpu_count() or 1
    refined, information = search.refine(*dense, candidate.matrix, rounds, threads)
    measured = fit(*fine, refined)
    if max(len(level.points) for level in dense) <= MOST_SHARED:
        closer = [*rounds, (spacing / 4, LAST_ITERATIONS)]  # where points without a twin have no partner
        by_points, _ = search.refine(*dense, refined, closer, threads, "ICP", tolerance=1e-7)
        if fit(*fine, by_points).median < measured.median / 2:
            return by_points, information
    return (candidate.matrix if measured.cost > candidate.fit.cost + verdict.CLOSE else refined), information


def _correspondences(frame: _Frame, matrix: Floats) -> NDArray[np.int64]:
    """Return points that are each other's nearest, `[n, 2]` positions in what was given; of large clouds, those of a part."""
    source, target = frame.normalised_clouds()
    steps = [1 + (len(cloud) - 1) // MOST_POINTS for cloud in (source, target)]
    moved, target = source[:: steps[0]] @ matrix[:3, :3].T + matrix[:3, 3], target[:: steps[1]]
    to_target = np.asarray(KDTree(target).query(moved, workers=-1)[1])
    to_source = np.asarray(KDTree(moved).query(target, workers=-1)[1])
    mutual = np.flatnonzero(to_source[to_target] == np.arange(len(moved)))
    return np.stack([frame.source.rows[mutual * steps[0]], frame.target.rows[to_target[mutual] * steps[1]]], axis=1)
