"""The frame in which two clouds are registered, whatever their unit and offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cmig_jax.registration.clouds import UserCloud
from cmig_jax.registration.levels import Level, grid_means
from cmig_jax.registration.scatter import without_scatter
from cmig_jax.transform import RigidTransform, check_transform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """Both clouds, and the normalised frame: each at its own centre, the larger of radius 1."""

    source: UserCloud
    target: UserCloud

    @property
    def scale(self) -> float:
        """What the coordinates are divided by."""
        return max(self.source.radius, self.target.radius)

    @property
    def ratio(self) -> float:
        """Radius of the larger cloud over that of the smaller."""
        return self.scale / min(self.source.radius, self.target.radius)

    def normalised_clouds(self) -> tuple[Floats, Floats]:
        """Return the points of both, `[N, 3]` and `[M, 3]`."""
        source, target = ((cloud.points - cloud.centre) / self.scale for cloud in (self.source, self.target))
        return source, target

    def levels(self, counts: Sequence[int]) -> list[tuple[Level, Level]]:
        """Return both clouds without scatter and with at most so many points, each level thinned from the one before."""
        clouds, radii = self.normalised_clouds(), (self.source.radius / self.scale, self.target.radius / self.scale)
        levels = []
        for count in counts:
            clouds = tuple(grid_means(cloud, count, radius) for cloud, radius in zip(clouds, radii, strict=True))
            pair = Level(clouds[0]), Level(clouds[1])
            if not levels:
                pair = without_scatter(pair[0]), without_scatter(pair[1])
                clouds = pair[0].points, pair[1].points
            levels.append(pair)
        return levels

    def normalised(self, pose: RigidTransform) -> Floats:
        """Return a pose between the clouds as they are, `[4, 4]` between the normalised ones."""
        R, t = np.asarray(pose.R, np.float64), np.asarray(pose.t, np.float64)
        return matrix_of(R, (R @ self.source.centre + t - self.target.centre) / self.scale)

    def original(self, matrix: Floats) -> RigidTransform:
        """Return a pose `[4, 4]` between the normalised clouds as one between those that were given."""
        R, t = matrix[:3, :3], matrix[:3, 3]
        return check_transform(R, self.target.centre + self.scale * t - R @ self.source.centre, "register")


def matrix_of(R: Floats, t: Floats) -> Floats:
    """Return the pose `[4, 4]` of a rotation `[3, 3]` and a translation `[3]`."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = R, t
    return matrix
