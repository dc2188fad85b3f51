"""Poses of many scans from registrations of some of their pairs: a spanning forest, then least squares on twists.

Each scan is given about its own centre, and a pose moves it into the frame of another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import lil_array
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
SAME_ANGLE, SAME_SHIFT = float(np.radians(5.0)), 0.05
"""Two poses of a scan agree within this angle and this part of its radius: what the verdict of a registration calls right."""
ROBUST = 0.02
"""Deviation (radians, parts of the radius) from which on an edge pulls less."""
LEAST_STIFFNESS = 1e-3
"""Added to an edge's information, whose mean eigenvalue is 1: no direction is free."""


@dataclass(frozen=True)
class Edge:
    """A registration of two scans, as a constraint.

    Attributes:
        source, target: numbers of the scans.
        matrix: target_from_source `[4, 4]`.
        scale: radius of the scans; a shift by it counts as much as a turn by one radian.
        information: `[6, 6]`, of (rotation vector, shift / scale) in the source's frame; its shape is used, not its size.
        confidence: that the registration is right, in [0, 1].
    """

    source: int
    target: int
    matrix: Floats
    scale: float
    information: Floats
    confidence: float

    def agrees(self, target_from_source: Floats) -> bool:
        """Say whether a pose is the same to `SAME_ANGLE` and `SAME_SHIFT`."""
        off = deviations(self.matrix, target_from_source, self.scale)
        return bool(np.linalg.norm(off[:3]) <= SAME_ANGLE and np.linalg.norm(off[3:]) <= SAME_SHIFT)

    def reversed(self) -> Edge:
        """Return the constraint from target to source, without its information."""
        return Edge(self.target, self.source, inverse(self.matrix), self.scale, np.eye(6), self.confidence)


@dataclass(frozen=True)
class Graph:
    """Poses of connected scans.

    Attributes:
        root: `[n]`, for each scan the lowest number among the scans that it is connected to.
        poses: `[n, 4, 4]`, root_from_scan.
        used: `[E]`, the edges that agree with the poses.
        confidence: `[n]`, smallest confidence of the edges that lead from a scan to its root; 1 for the root.
    """

    root: NDArray[np.int64]
    poses: Floats
    used: NDArray[np.bool_]
    confidence: Floats

    def relative(self, source: int, target: int) -> Floats:
        """Return target_from_source `[4, 4]` of two scans of one root."""
        return inverse(self.poses[target]) @ self.poses[source]

    def members(self, root: int) -> list[int]:
        """List the scans of a root."""
        return np.flatnonzero(self.root == root).tolist()


def solve(count: int, edges: Sequence[Edge]) -> Graph:
    """Find the poses of `count` scans that agree with the edges.

    Edges that others confirm come first into a spanning forest, which is the start; least squares then distributes over each loop what it
    does not close by. While an edge does not agree with the result, the worst one, rather one outside the forest, is left out.
    """
    order = np.argsort([-value for value in _support(edges)], kind="stable").tolist()
    used = np.ones(len(edges), bool)
    while True:
        tree, root, poses, confidence = _forest(count, edges, [i for i in order if used[i]])
        poses = _optimised(root, poses, [edges[i] for i in np.flatnonzero(used).tolist()])
        graph = Graph(root, poses, used.copy(), confidence)
        wrong = [i for i in np.flatnonzero(used).tolist() if not edges[i].agrees(graph.relative(edges[i].source, edges[i].target))]
        if not wrong:
            return graph
        used[max([i for i in wrong if i not in tree] or wrong, key=lambda i: _size(edges[i], graph))] = False


def inverse(matrix: Floats) -> Floats:
    """Return the inverses of rigid transforms `[..., 4, 4]`."""
    result = np.zeros_like(matrix)
    result[..., :3, :3] = np.swapaxes(matrix[..., :3, :3], -1, -2)
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", result[..., :3, :3], matrix[..., :3, 3])
    result[..., 3, 3] = 1
    return result


def deviations(measured: Floats, other: Floats, scale: Floats | float) -> Floats:
    """Return measured^-1 other as (rotation vector, shift / scale) `[..., 6]`, of poses `[..., 4, 4]` and radii `[...]`."""
    off = inverse(measured) @ other
    turn = Rotation.from_matrix(off[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*off.shape[:-2], 3)
    return np.concatenate([turn, off[..., :3, 3] / np.asarray(scale)[..., None]], axis=-1)


def _size(edge: Edge, graph: Graph) -> float:
    return float(np.linalg.norm(deviations(edge.matrix, graph.relative(edge.source, edge.target), edge.scale)))


def _support(edges: Sequence[Edge]) -> list[float]:
    """Return each edge's confidence, plus that of pairs of other edges that lead to the same pose by way of a third scan."""
    between: dict[tuple[int, int], list[Edge]] = {}
    for edge in [*edges, *(edge.reversed() for edge in edges)]:
        between.setdefault((edge.source, edge.target), []).append(edge)
    support = []
    for edge in edges:
        thirds = [target for source, target in between if source == edge.source]
        detours = [
            (first, last)
            for third in thirds
            for first in between[edge.source, third]
            for last in between.get((third, edge.target), ())
            if edge.agrees(last.matrix @ first.matrix)
        ]
        support.append(edge.confidence + sum(first.confidence * last.confidence for first, last in detours))
    return support


def _forest(count: int, edges: Sequence[Edge], order: Sequence[int]) -> tuple[set[int], NDArray[np.int64], Floats, Floats]:
    """Join scans by the edges in an order; return the edges that it took, and each scan's root, pose and confidence."""
    root, poses, confidence = np.arange(count), np.tile(np.eye(4), (count, 1, 1)), np.ones(count)
    tree = set()
    for i in order:
        edge = edges[i] if root[edges[i].source] > root[edges[i].target] else edges[i].reversed()
        if root[edge.source] != root[edge.target]:
            moved = root == root[edge.source]
            poses[moved] = poses[edge.target] @ edge.matrix @ inverse(poses[edge.source]) @ poses[moved]
            least = min(edge.confidence, confidence[edge.source], confidence[edge.target])
            confidence[moved] = np.minimum(confidence[moved], least)
            root[moved] = root[edge.target]
            tree.add(i)
    return tree, root, poses, confidence


def _optimised(root: NDArray[np.int64], poses: Floats, edges: Sequence[Edge]) -> Floats:
    """Minimise the deviations of all edges over a twist per scan; the roots stay."""
    free = np.flatnonzero(root != np.arange(len(root)))
    if len(edges) <= len(free):  # a forest fits exactly
        return poses
    source, target = np.array([edge.source for edge in edges]), np.array([edge.target for edge in edges])
    measured, scale = np.stack([edge.matrix for edge in edges]), np.array([edge.scale for edge in edges])
    stiffness = np.stack([_stiffness(edge.information) for edge in edges])

    def moved(twists: Floats) -> Floats:
        result, twist = poses.copy(), twists.reshape(-1, 6)
        result[free, :3, :3] = poses[free, :3, :3] @ Rotation.from_rotvec(twist[:, :3]).as_matrix()
        result[free, :3, 3] += twist[:, 3:] * scale.max()
        return result

    def residuals(twists: Floats) -> Floats:
        found = moved(twists)
        off = deviations(measured, inverse(found[target]) @ found[source], scale)
        return np.einsum("eij,ej->ei", stiffness, off).ravel()

    column = np.full(len(root), -1)
    column[free] = np.arange(len(free))
    pattern = lil_array((6 * len(edges), 6 * len(free)), dtype=int)
    for row, ends in enumerate(zip(column[source], column[target], strict=True)):
        for end in ends:
            if end >= 0:
                pattern[6 * row : 6 * row + 6, 6 * end : 6 * end + 6] = 1
    start = np.zeros(6 * len(free))
    return moved(least_squares(residuals, start, jac_sparsity=pattern, loss="soft_l1", f_scale=ROBUST, x_scale="jac").x)


def _stiffness(information: Floats) -> Floats:
    """Return `S` such that S^T S is the information with a mean eigenvalue of 1; the identity if there is none."""
    size = np.trace(information) / 6
    if not size > 0:
        return np.eye(6)
    return np.linalg.cholesky(information / size + LEAST_STIFFNESS * np.eye(6)).T
