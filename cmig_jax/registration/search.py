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

from cmig_jax.registration.fit import Fit, fit
from cmig_jax.registration.levels import Level

Floats = NDArray[np.float64]
ROTATIONS = 400
"""Rotations that cover all turns; on training objects 1,000 find no more poses."""
KEPT = 24
SAME_ANGLE_DEG, SAME_SHIFT = 8.0, 0.08
COARSE, FINE = ((0.3, 15),), ((0.15, 20), (0.05, 30))
"""Cutoff and iterations of each round of generalised ICP, on the coarse and on the fine points."""


@dataclass(frozen=True)
class Candidate:
    """A pose between normalised clouds, target_from_source `[4, 4]`, its fit, and how many starts led to it."""

    matrix: Floats
    fit: Fit
    starts: int = 1


def rotations(limit_deg: float) -> list[Floats]:
    """Return rotations `[3, 3]` spread evenly over those by at most `limit_deg`; the first is the identity.

    They are a super-Fibonacci spiral of unit quaternions (Alexa, CVPR 2022).
    """
    s = np.arange(ROTATIONS) + 0.5
    inner, outer = np.sqrt(s / ROTATIONS), np.sqrt(1 - s / ROTATIONS)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    spiral = np.stack([inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)], axis=1)
    turns = Rotation.from_quat(spiral)
    return [np.eye(3), *turns[turns.magnitude() <= np.radians(limit_deg)].as_matrix()]


def refine(
    source: Level,
    target: Level,
    start: Floats,
    rounds: Sequence[tuple[float, int]],
    threads: int = 1,
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
            num_threads=threads,
            max_iterations=iterations,
            rotation_epsilon=tolerance,
            translation_epsilon=tolerance,
        )
        if found.num_inliers > 0 and np.isfinite(found.T_target_source).all():
            pose, information = np.array(found.T_target_source), np.array(found.H)
    return pose, information


def find(coarse: tuple[Level, Level], fine: tuple[Level, Level], starts: Sequence[Floats], limit_deg: float = 180.0) -> list[Candidate]:
    """Refine poses `[4, 4]` on coarse clouds, and those that fit best on fine ones.

    Args:
        coarse, fine: source and target.
        starts: poses to start from.
        limit_deg: poses that turn by more (and `SAME_ANGLE_DEG`) are left out; if all do, the starts are the poses.

    Returns:
        Poses that differ, best fit first.
    """
    first = distinct([Candidate(found, fit(*coarse, found)) for found in (refine(*coarse, start, COARSE)[0] for start in starts)])
    refined = [(refine(*fine, candidate.matrix, FINE)[0], candidate.starts) for candidate in first[:KEPT]]
    within = [(found, count) for found, count in refined if _angle_deg(found) <= limit_deg + SAME_ANGLE_DEG]
    return distinct([Candidate(found, fit(*fine, found), count) for found, count in within or [(start, 1) for start in starts]])


def distinct(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Sort by fit, and join poses that are within `SAME_ANGLE_DEG` and `SAME_SHIFT` of a better one."""
    kept: list[Candidate] = []
    for new in sorted(candidates, key=lambda candidate: candidate.fit.cost):
        same = next((i for i, old in enumerate(kept) if _same(old.matrix, new.matrix)), None)
        if same is None:
            kept.append(new)
        else:
            kept[same] = Candidate(kept[same].matrix, kept[same].fit, kept[same].starts + new.starts)
    return kept


def _angle_deg(matrix: Floats) -> float:
    return float(np.degrees(Rotation.from_matrix(matrix[:3, :3]).magnitude()))


def _same(one: Floats, other: Floats) -> bool:
    turned = np.trace(one[:3, :3].T @ other[:3, :3]) < 1 + 2 * np.cos(np.radians(SAME_ANGLE_DEG))
    return not turned and bool(np.linalg.norm(one[:3, 3] - other[:3, 3]) < SAME_SHIFT)
