"""A cloud at one density, prepared for generalised ICP (small_gicp) and for measuring a fit."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import small_gicp
from numpy.typing import NDArray
from scipy.spatial import KDTree

Floats = NDArray[np.float64]
NORMAL_NEIGHBOURS, COVARIANCE_NEIGHBOURS = 12, 20
GROWTH = 1.12
BEYOND = 1e3


@dataclass(frozen=True)
class Level:
    """A cloud of some density; what is derived from it is computed when it is asked for.

    Attributes:
        points: `[N, 3]`, at least three.
    """

    points: Floats

    @functools.cached_property
    def tree(self) -> KDTree:
        """Tree for nearest neighbours."""
        return KDTree(self.points)

    @functools.cached_property
    def neighbours(self) -> tuple[Floats, NDArray[np.int64]]:
        """Distances and positions `[N, k]` of the nearest points, each itself first."""
        distances, index = self.tree.query(self.points, k=min(NORMAL_NEIGHBOURS, len(self.points)), workers=-1)
        return distances, np.asarray(index)

    @functools.cached_property
    def spacing(self) -> float:
        """Median distance from a point to the nearest other one."""
        return float(np.median(self.neighbours[0][:, 1]))

    @functools.cached_property
    def normals(self) -> Floats:
        """Normals `[N, 3]` of the plane through each point's neighbours, of either sign."""
        around = self.points[self.neighbours[1]]
        around = around - around.mean(axis=1, keepdims=True)
        return np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]

    @functools.cached_property
    def prepared(self) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
        """The cloud with covariances, and its tree, as small_gicp takes them.

        It prints a warning about clouds of 10 points or fewer, every time; to these a point is added beyond all cutoffs.
        """
        added = [[BEYOND, BEYOND, BEYOND]] if len(self.points) <= 10 else np.zeros((0, 3))
        cloud = small_gicp.PointCloud(np.concatenate([self.points, added]))
        tree = small_gicp.KdTree(cloud)
        small_gicp.estimate_covariances(cloud, tree, num_neighbors=min(COVARIANCE_NEIGHBOURS, len(self.points)), num_threads=1)
        return cloud, tree


def grid_means(points: Floats, count: int, extent: float) -> Floats:
    """Replace the points of each cell of a grid by their mean, with the smallest cells that leave at most `count` points.

    Args:
        points: `[N, 3]`.
        count: most points to keep.
        extent: radius of the cloud.

    Returns:
        `[n, 3]`, n at most `count`; the points themselves if they are no more than that.
    """
    cell = extent / np.sqrt(count)
    while len(points) > count:
        points = np.asarray(small_gicp.voxelgrid_sampling(points, cell).points())[:, :3]
        cell *= GROWTH
    return points
