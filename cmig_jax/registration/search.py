"""Search for the pose of two clouds: many starts on few points, the best of them refined on more points.

The clouds are normalised: each at its own centre, both scaled so that the radius of the larger is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmig_jax.registration.evidence import turn_deg
from cmig_jax.registration.fit import Fit, fit
from cmig_jax.registration.frame import matrix_of
from cmig_jax.registration.levels import Level

Floats = NDArray[np.float64]
Rounds = Sequence[tuple[float, int]]
NOT_MEASURED = Fit(np.inf, (0.0, 0.0), np.inf, np.inf)
ROTATIONS = 400
"""Rotations that cover all turns; on training objects 1,000 find no more poses."""
KEPT = 24
NEAR_DEG = 25.0
"""How far around a given start rotations are tried."""
SAME_ANGLE_DEG, SAME_SHIFT = 8.0, 0.08
YAW_STEP_DEG, MOST_TILT_DEG = 10.0, 10.0
"""Turns about the vertical: the step between those that are tried, and how far a pose may tilt it."""
SLID, SLIDES = 6, (-0.4, -0.2, 0.2, 0.4)
"""So many of the best poses are tried again, moved by so much along each principal axis of the target."""
COARSE, NEAR, FINE = ((0.3, 15),), ((0.15, 15),), ((0.15, 20), (0.05, 30))
"""Cutoff and iterations of each round of generalised ICP: on the coarse points, on those after a slide, and on the fine points."""


@dataclass(frozen=True)
class Candidate:
    """A pose between normalised clouds, target_from_source `[4, 4]`, its fit, and how many starts led to it."""

    matrix: Floats
    fit: Fit
    starts: int = 1


def rotations(limit_deg: float, up: Floats | None = None) -> list[Floats]:
    """Return rotations `[3, 3]` spread evenly over those by at most `limit_deg`; the first is the identity.

    They are a super-Fibonacci spiral of unit quaternions (Alexa, CVPR 2022); with `up`, a direction `[3]`, turns about it.
    """
    if up is not None:
        steps = np.arange(1, 180 / YAW_STEP_DEG + 1) * YAW_STEP_DEG
        angles = np.concatenate([[0.0], steps, -steps[:-1]])
        return list(Rotation.from_rotvec(np.radians(angles[np.abs(angles) <= limit_deg])[:, None] * up).as_matrix())
    s = np.arange(ROTATIONS) + 0.5
    inner, outer = np.sqrt(s / ROTATIONS), np.sqrt(1 - s / ROTATIONS)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    spiral = np.stack([inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)], axis=1)
    turns = Rotation.from_quat(spiral)
    return [np.eye(3), *turns[turns.magnitude() <= np.radians(limit_deg)].as_matrix()]


def starts(limit_deg: float, up: Floats | None = None, init: Floats | None = None) -> list[Floats]:
    """Return poses `[4, 4]` to start from: rotations about the centres, or around `init` those by at most `NEAR_DEG`."""
    if init is None:
        return [matrix_of(R, np.zeros(3)) for R in rotations(limit_deg, up)]
    return [matrix_of(R @ init[:3, :3], init[:3, 3]) for R in rotations(min(limit_deg, NEAR_DEG), up)]


def refine(
    source: Level,
    target: Level,
    start: Floats,
    rounds: Rounds,
    kind: Literal["GICP", "ICP"] = "GICP",
    tolerance: float = 1e-3,
) -> tuple[Floats, Floats]:
    """Refine a pose by generalised or point-to-point ICP, one round per (cutoff, iterations).

    Returns:
        The pose `[4, 4]`, and the Hessian of the last round `[6, 6]` with respect to (rotation, translation). A round that finds no
        partners, or no valid pose, keeps the pose before it.
    """
    pose, information = start, np.zeros((6, 6))
    for cutoff, iterations in rounds:
        found = small_gicp.align(
            target.prepared[0],
            source.prepared[0],
            target.prepared[1],
            init_T_target_source=pose,
            registration_type=kind,
            max_correspondence_distance=cutoff,
            num_threads=1,  # several add up in another order each time; on 100,000 points they would save 0.1 s
            max_iterations=iterations,
            rotation_epsilon=tolerance,
            translation_epsilon=tolerance,
        )
        if found.num_inliers > 0 and np.isfinite(found.T_target_source).all():
            pose, information = np.array(found.T_target_source), np.array(found.H)
    return pose, information


def find(
    coarse: tuple[Level, Level], fine: tuple[Level, Level], starts: Sequence[Floats], limit_deg: float = 180.0, up: Floats | None = None
) -> list[Candidate]:
    """Refine poses `[4, 4]` on coarse clouds, and those that fit best on fine ones; and again from where the best may have slid to.

    Args:
        coarse, fine: source and target.
        starts: poses to start from.
        limit_deg: poses that turn by more (and `SAME_ANGLE_DEG`) are left out; if all do, the starts are the poses.
        up: poses that tilt this direction `[3]` by more than `MOST_TILT_DEG` are left out too.

    Returns:
        Poses that differ, best fit first.
    """

    def from_starts(starts: Sequence[Floats], rounds: Rounds, each: int) -> list[Candidate]:
        first = distinct(_refined(coarse, [Candidate(start, NOT_MEASURED, each) for start in starts], rounds))
        found = _refined(fine, first[:KEPT], FINE)
        return [c for c in found if allowed(c.matrix, limit_deg, up)]

    found = distinct(from_starts(starts, COARSE, 1))
    if not found:
        return distinct([Candidate(start, fit(*fine, start)) for start in starts])
    return distinct([*found, *from_starts(_slid(found[:SLID], coarse[1]), NEAR, 0)])


def allowed(matrix: Floats, limit_deg: float, up: Floats | None) -> bool:
    """Say whether a pose keeps to a bound on its angle, by `SAME_ANGLE_DEG` at most beyond, and tilts `up` by `MOST_TILT_DEG` at most."""
    upright = up is None or up @ matrix[:3, :3] @ up >= np.cos(np.radians(MOST_TILT_DEG))
    return bool(upright and turn_deg(matrix) <= limit_deg + SAME_ANGLE_DEG)


def _refined(clouds: tuple[Level, Level], candidates: Sequence[Candidate], rounds: Rounds) -> list[Candidate]:
    poses = [refine(*clouds, candidate.matrix, rounds)[0] for candidate in candidates]
    return [Candidate(pose, fit(*clouds, pose), candidate.starts) for pose, candidate in zip(poses, candidates, strict=True)]


def _slid(candidates: Sequence[Candidate], target: Level) -> list[Floats]:
    """Return the poses moved along the principal axes: two crops of a long object have their centres apart."""
    axes = np.linalg.svd(target.points - target.points.mean(axis=0), full_matrices=False)[2]
    moved = []
    for candidate in candidates:
        for step in (size * axis for axis in axes for size in SLIDES):
            pose = candidate.matrix.copy()
            pose[:3, 3] += step
            moved.append(pose)
    return moved


def distinct(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Sort by fit, and join poses that are within `SAME_ANGLE_DEG` and `SAME_SHIFT` of a better one."""
    ordered = sorted(candidates, key=lambda candidate: candidate.fit.cost)
    R = np.array([candidate.matrix[:3, :3].ravel() for candidate in ordered])
    t = np.array([candidate.matrix[:3, 3] for candidate in ordered])
    least_trace = 1 + 2 * np.cos(np.radians(SAME_ANGLE_DEG))
    kept: dict[int, Candidate] = {}
    for i, new in enumerate(ordered):
        better = list(kept)
        same = (R[better] @ R[i] >= least_trace) & (np.linalg.norm(t[better] - t[i], axis=1) < SAME_SHIFT)
        if same.any():
            first = better[int(np.argmax(same))]
            kept[first] = Candidate(kept[first].matrix, kept[first].fit, kept[first].starts + new.starts)
        else:
            kept[i] = new
    return list(kept.values())
