"""What speaks for a pose and against it: how the points of each cloud meet the other one.

Each number is the sum over both clouds of a mean over points. Lengths are in spacings of the clouds. A learnt verdict weighs them
(`verdict`), since no single one of them chooses well between the poses that a search finds.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cmig_jax.registration.fit import PARTNER, Meeting, meetings
from cmig_jax.registration.levels import Level

Floats = NDArray[np.float64]
DISTANCES = ((0.0, 0.5), (0.5, 1.0), (1.5, 2.0), (2.0, 3.0), (3.0, 5.0))
TO_PLANE = ((0.0, 0.2), (0.2, 0.4), (0.6, 1.0), (1.0, 2.0))
PARALLEL = ((0.0, 0.5), (0.5, 0.8), (0.8, 0.95))
"""Intervals of a point's distance to its nearest neighbour in the other cloud, of that to its plane, and of the cosine between the
normals."""
CUTS, BEYOND = 60, 0.85
"""Directions of planes that may have cut a cloud off, and what a point beyond the plane costs without a partner."""


def evidence(source: Level, target: Level, matrix: Floats) -> dict[str, float]:
    """Weigh a pose.

    Args:
        source, target: the clouds.
        matrix: target_from_source `[4, 4]`.

    Returns:
        Names and numbers, each in [0, 2]: `cost` of points as in `fit`; `cut`, the cost if a plane has cut off each cloud; `partners`,
        points that have one; points with some `distance`, and partners with some distance to the `plane` or with some angle (`parallel`),
        each named by the lower end of its interval; and `worse`, the larger of the two clouds' costs and shares.
    """
    met = meetings(source, target, matrix, DISTANCES[-1][1])
    R, t = matrix[:3, :3], matrix[:3, 3]
    one, other = _one_sided(met[0], source.points @ R.T + t), _one_sided(met[1], (target.points - t) @ R)
    found = {name: one[name] + other[name] for name in one}
    return found | {f"worse_{name}": max(one[name], other[name]) for name in ("cost", "cut", "partners")}


def turn_deg(matrix: Floats) -> float:
    """Return the angle of a pose's rotation."""
    return float(np.degrees(Rotation.from_matrix(matrix[:3, :3]).magnitude()))


def _one_sided(met: Meeting, points: Floats) -> dict[str, float]:
    partner = met.distance < PARTNER
    return {
        "cost": float(met.cost.mean()),
        "cut": _cut(points, met.cost),
        "partners": float(partner.mean()),
        **{f"distance_{low:g}": _share(met.distance, low, high) for low, high in DISTANCES},
        **{f"plane_{low:g}": _share(met.to_plane, low, high, partner) for low, high in TO_PLANE},
        **{f"parallel_{low:g}": _share(met.parallel, low, high, partner) for low, high in PARALLEL},
    }


def _share(values: Floats, low: float, high: float, among: NDArray[np.bool_] | None = None) -> float:
    inside = (values >= low) & (values < high)
    return float(np.mean(inside if among is None else inside & among))


def _cut(points: Floats, cost: Floats) -> float:
    """Return the least mean cost over planes beyond which a point costs `BEYOND`, and more if it has a partner there."""
    order = np.argsort(points @ _directions().T, axis=0)
    kept, beyond = cost[order], (1 - cost + BEYOND)[order]
    nothing = np.zeros((1, CUTS))
    until = np.concatenate([nothing, np.cumsum(kept, axis=0)])
    after = np.concatenate([np.cumsum(beyond[::-1], axis=0)[::-1], nothing])
    return float((until + after).min() / len(points))


@functools.cache
def _directions() -> Floats:
    """Return directions `[CUTS, 3]` on a Fibonacci spiral."""
    height = 1 - (2 * np.arange(CUTS) + 1) / CUTS
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(CUTS)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
