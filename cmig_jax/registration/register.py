"""Two clouds of a user's own in, their registration out."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from cmig_jax.registration import search, verdict
from cmig_jax.registration.clouds import user_cloud
from cmig_jax.registration.fit import fit
from cmig_jax.registration.frame import Frame
from cmig_jax.registration.levels import Level
from cmig_jax.registration.result import Registration
from cmig_jax.transform import RigidTransform

Floats = NDArray[np.float64]
MOST_POINTS = 100_000
LEVELS = (MOST_POINTS, 1_200, 250)
"""Most points of the clouds in the last refinement, in the choice of a pose, and in the search."""
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
MOST_ALTERNATIVES = 8
MOST_SHARED = 10_000
"""Larger clouds are not expected to share their points."""
WORSE = 0.02
"""The last refinement is dropped if the cost grows by more."""
LAST_CUTOFF, SPACINGS, LEAST_SPACINGS, LAST_ITERATIONS = 0.05, 3.0, 2.0, 30
"""Cutoff of the last refinement: `SPACINGS` of the clouds or `LAST_CUTOFF` if that is less, but at least `LEAST_SPACINGS`, within which
nearly every point of two samplings has a partner."""


def register(
    source: Any,
    target: Any,
    network: Any = None,
    *,
    init: RigidTransform | None = None,
    rotations: Literal["any", "yaw"] | float = "any",
    up: Literal["x", "y", "z"] = "z",
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
        init: a pose near the right one: only rotations within `search.NEAR_DEG` of it are tried.
        rotations: largest angle of the rotation in degrees, or `yaw` for turns about the vertical alone (a scanner that stands upright),
            if that is known: fewer starts, and fewer poses to mistake for the right one. A pose may tilt the vertical by
            `search.MOST_TILT_DEG`.
        up: axis of the vertical in both clouds, for `yaw`.
        refine: without it, return the pose of the network as it is.
        invalid: `drop` leaves out rows that are not finite.

    Returns:
        The pose, NumPy float64, in the unit of the clouds, with its verdict.

    Raises:
        ValueError: a cloud that is not `[N, 3]` numbers, not finite, with fewer than `clouds.FEWEST` different points or all points on one
            line; a network that does not fit the clouds; an argument out of range.
    """
    limit, vertical = _checked_limit(rotations, up)
    if not refine and network is None:
        raise ValueError("refine = False: expected a network, whose pose is then returned as it is")
    clock = _Clock()
    frame = Frame(user_cloud(source, "source", invalid), user_cloud(target, "target", invalid))
    dense, fine, coarse = frame.levels(LEVELS)
    clock.stage("clouds")
    starts = [] if network is None else [frame.normalised(_pose_of_network(network, frame))]
    clock.stage("network")
    if refine:
        starts += search.starts(limit, vertical, None if init is None else frame.normalised(init))
        bound = (limit, vertical) if init is None else (180.0, None)
        candidates = search.find(coarse, fine, starts, *bound)
        clock.stage("search")
        chosen, *others = verdict.weigh(*fine, candidates, bound[0])
        clock.stage("choice")
        best, information = _refined(dense, fine, chosen.candidate)
        best = best if search.allowed(best, *bound) else chosen.candidate.matrix
    else:
        chosen, *others = verdict.weigh(*fine, [search.Candidate(starts[0], fit(*fine, starts[0]))], limit)
        best, information = starts[0], np.zeros((6, 6))
    pairs = _correspondences(frame, best)
    clock.stage("refinement")
    measured = fit(*fine, best)
    confidence = verdict.confidence(chosen)
    close = [each.candidate.matrix for each in others if each.probability > verdict.CLOSE * chosen.probability]
    return Registration(
        target_from_source=frame.original(best),
        trusted=confidence >= verdict.TRUSTED,
        why=verdict.explain(confidence, chosen, frame.ratio),
        confidence=confidence,
        overlap=measured.overlap,
        inlier_rmse=measured.rmse * frame.scale,
        correspondences=pairs,
        information=information,
        alternatives=tuple(frame.original(matrix) for matrix in close[:MOST_ALTERNATIVES]),
        dropped=(frame.source.dropped, frame.target.dropped),
        seconds=clock.seconds,
    )


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stage(self, name: str) -> None:
        """End a stage."""
        now = time.perf_counter()
        self.seconds[name], self._last = now - self._last, now


def _checked_limit(rotations: Literal["any", "yaw"] | float, up: Literal["x", "y", "z"]) -> tuple[float, Floats | None]:
    """Return the largest angle in degrees, and the axis `[3]` if there is only one."""
    if up not in AXES:
        raise ValueError(f"up = {up!r}: expected x, y or z")
    if rotations == "yaw":
        return 180.0, np.array(AXES[up])
    if rotations == "any":
        return 180.0, None
    if isinstance(rotations, str) or not 0 <= rotations <= 180:
        raise ValueError(f"rotations = {rotations!r}: expected any, yaw, or an angle of 0 to 180 degrees")
    return float(rotations), None


def _pose_of_network(network: Any, frame: Frame) -> RigidTransform:
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
    rounds = [(max(min(LAST_CUTOFF, SPACINGS * spacing), LEAST_SPACINGS * spacing), LAST_ITERATIONS)]
    refined, information = search.refine(*dense, candidate.matrix, rounds)
    measured = fit(*fine, refined)
    if max(len(level.points) for level in dense) <= MOST_SHARED:
        closer = [*rounds, (spacing / 4, LAST_ITERATIONS)]  # where points without a twin have no partner
        by_points, _ = search.refine(*dense, refined, closer, "ICP", tolerance=1e-7)
        if fit(*fine, by_points).median < measured.median / 2:
            return by_points, information
    return (candidate.matrix if measured.cost > candidate.fit.cost + WORSE else refined), information


def _correspondences(frame: Frame, matrix: Floats) -> NDArray[np.int64]:
    """Return points that are each other's nearest, `[n, 2]` positions in what was given; of large clouds, those of a part."""
    source, target = frame.normalised_clouds()
    steps = [1 + (len(cloud) - 1) // MOST_POINTS for cloud in (source, target)]
    moved, target = source[:: steps[0]] @ matrix[:3, :3].T + matrix[:3, 3], target[:: steps[1]]
    to_target = np.asarray(KDTree(target).query(moved, workers=-1)[1])
    to_source = np.asarray(KDTree(moved).query(target, workers=-1)[1])
    mutual = np.flatnonzero(to_source[to_target] == np.arange(len(moved)))
    return np.stack([frame.source.rows[mutual * steps[0]], frame.target.rows[to_target[mutual] * steps[1]]], axis=1)
