"""Several scans of one scene in, all their poses out: registrations of pairs, checked against each other, and a pose graph."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from cmig_jax.registration.clouds import UserCloud, user_cloud
from cmig_jax.registration.levels import Level, grid_means
from cmig_jax.registration.pose_graph import Edge, Graph, solve
from cmig_jax.registration.register import MOST_POINTS, register
from cmig_jax.registration.result import Registration
from cmig_jax.registration.scan_sequence import PairOfScans, Scan, ScanSequence
from cmig_jax.registration.threads import as_they_finish
from cmig_jax.transform import RigidTransform, check_transform

Floats = NDArray[np.float64]
ALL_PAIRS_UP_TO = 12
"""Of more scans, only those that follow each other are registered without knowing that they overlap."""
OVERLAP_POINTS, LEAST_OVERLAP = 1_000, 0.3
"""Scans whose poses say that they share this much are registered, on so many points each."""


def register_sequence(
    clouds: Sequence[Any],
    network: Any = None,
    *,
    rotations: Literal["any", "yaw"] | float = "any",
    up: Literal["x", "y", "z"] = "z",
    invalid: Literal["error", "drop"] = "error",
    names: Sequence[str] | None = None,
    progress: bool = False,
) -> ScanSequence:
    """Find the poses of several scans in the frame of the first.

    Up to `ALL_PAIRS_UP_TO` scans, all pairs are registered, and the order of the scans does not matter. Of more, those that follow each
    other are, and later those that overlap by their poses. Trusted registrations make a pose graph; others are used if they agree with
    it. A group of scans that nothing trusted connects to the first is registered, as one cloud, onto all that are connected to it.

    Args:
        clouds: two or more, of what `register` takes, in one unit.
        network: as of `register`.
        rotations: as of `register`. An angle bounds the rotation between two scans that follow each other, and these alone are then
            registered first.
        up: axis of the vertical in all clouds, for `yaw`.
        invalid: `drop` leaves out rows that are not finite.
        names: of the clouds in errors and explanations.
        progress: whether to draw bars.

    Raises:
        ValueError: fewer than two clouds, or what `register` raises; the message names the scan.
    """
    if len(clouds) < 2:
        raise ValueError(f"{len(clouds)} scans; expected at least two")
    names = [f"scan {i}" for i in range(len(clouds))] if names is None else names
    given = [user_cloud(cloud, name, invalid) for cloud, name in zip(clouds, names, strict=True)]
    search = _Search(given, _loaded(network), "yaw" if rotations == "yaw" else "any", up, progress)
    if len(given) <= ALL_PAIRS_UP_TO and isinstance(rotations, str):
        search.register_pairs(itertools.combinations(range(len(given)), 2), rotations)
    else:
        search.register_pairs([(i, i + 1) for i in range(len(given) - 1)], rotations)
    search.join_groups()
    while overlapping := search.overlapping():
        search.register_pairs(overlapping, search.rotations)
    return search.result(names)


def _loaded(network: Any) -> Any:
    if not isinstance(network, (str, Path)):
        return network
    from cmig_jax.inference.load import load

    return load(network)


@dataclass
class _Search:
    """The registrations so far: source, target, and what was found for clouds about their own centres."""

    given: list[UserCloud]
    network: Any
    rotations: Literal["any", "yaw"]
    up: Literal["x", "y", "z"]
    progress: bool
    pairs: list[tuple[tuple[int, ...], tuple[int, ...], Registration]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clouds = [grid_means(cloud.points - cloud.centre, MOST_POINTS, cloud.radius) for cloud in self.given]

    @functools.cached_property
    def thin(self) -> list[Level]:
        """The clouds as their overlap is measured."""
        return [Level(grid_means(cloud, OVERLAP_POINTS, given.radius)) for cloud, given in zip(self.clouds, self.given, strict=True)]

    def tried(self) -> set[frozenset[int]]:
        """Return the scans of each registration."""
        return {frozenset(source + target) for source, target, _ in self.pairs}

    def register_pairs(self, pairs: Iterable[tuple[int, int]], rotations: Literal["any", "yaw"] | float) -> None:
        """Register pairs of scans. The smaller scan is the source, so that the order of the scans changes nothing."""
        ordered = [sorted(pair, key=lambda i: (len(self.clouds[i]), float(np.abs(self.clouds[i]).sum()))) for pair in pairs]

        def run(pair: list[int]) -> Registration:
            return register(self.clouds[pair[0]], self.clouds[pair[1]], self.network, rotations=rotations, up=self.up)

        found = dict(tqdm(as_they_finish(run, ordered), total=len(ordered), unit="pair", disable=not self.progress))
        self.pairs += [((source,), (target,), found[i]) for i, (source, target) in enumerate(ordered)]

    def join_groups(self) -> None:
        """Register each group that is not connected to the first scan onto all scans that are; again, with each that is trusted."""
        joined = True
        while joined:
            joined, graph = False, self.solved()[0]
            first = tuple(graph.members(0))
            groups = [tuple(graph.members(root)) for root in sorted(set(graph.root.tolist()) - {0})]
            for group in sorted(groups, key=len, reverse=True):
                if not joined and frozenset(group + first) not in self.tried():
                    source, target = (np.concatenate([self._moved(i, graph) for i in scans]) for scans in (group, first))
                    found = register(source, target, self.network, rotations=self.rotations, up=self.up)
                    self.pairs.append((group, first, found))
                    joined = found.trusted

    def overlapping(self) -> list[tuple[int, int]]:
        """Return the pairs that overlap by their poses and were not tried yet."""
        graph, tried = self.solved()[0], self.tried()
        return [
            (i, j)
            for i, j in itertools.combinations(range(len(self.given)), 2)
            if graph.root[i] == graph.root[j]
            and frozenset((i, j)) not in tried
            and self._overlap(i, j, graph.relative(i, j)) > LEAST_OVERLAP
        ]

    def _overlap(self, source: int, target: int, target_from_source: Floats) -> float:
        """Return the share of the smaller scan that is near the other."""
        reach = 2 * max(self.thin[source].spacing, self.thin[target].spacing)
        moved = self.thin[source].points @ target_from_source[:3, :3].T + target_from_source[:3, 3]
        near = np.isfinite(self.thin[target].tree.query(moved, distance_upper_bound=reach)[0])
        return float(near.sum() / min(len(moved), len(self.thin[target].points)))

    def solved(self) -> tuple[Graph, list[Edge], NDArray[np.bool_]]:
        """Return poses by trusted registrations and those that agree with them; all edges; and which of them the poses use."""
        edges = [self._edge(*pair) for pair in self.pairs]
        chosen = np.array([found.trusted for _, _, found in self.pairs], bool)
        graph = solve(len(self.clouds), [edge for edge, choose in zip(edges, chosen, strict=True) if choose])
        for i, edge in enumerate(edges):
            if graph.root[edge.source] == graph.root[edge.target]:
                chosen[i] |= edge.agrees(graph.relative(edge.source, edge.target))
        positions = np.flatnonzero(chosen)
        graph = solve(len(self.clouds), [edges[i] for i in positions])
        used = np.zeros(len(edges), bool)
        used[positions[graph.used]] = True
        return graph, edges, used

    def result(self, names: Sequence[str]) -> ScanSequence:
        """Return poses in the frames of the clouds as they were given."""
        graph, _, used = self.solved()
        pairs = []
        for (source, target, found), use in zip(self.pairs, used.tolist(), strict=True):
            pose = self._as_given(source[0], target[0], found.matrix)
            measured = found.trusted, found.confidence, found.overlap, found.inlier_rmse
            pairs.append(PairOfScans(source, target, pose, *measured, use, _why(found, use)))
        return ScanSequence(tuple(self._scan(i, graph, pairs, names) for i in range(len(names))), tuple(pairs))

    def _scan(self, i: int, graph: Graph, pairs: Sequence[PairOfScans], names: Sequence[str]) -> Scan:
        root, confidence = int(graph.root[i]), float(graph.confidence[i])
        own = [pair for pair in pairs if i in pair.source + pair.target]
        if root != 0:
            why = f"left out: no trusted registration connects it to {names[0]} ({len(own)} were tried)"
            return Scan(names[i], None, root, confidence, why)
        begin = "all are in its frame" if i == 0 else f"placed with confidence {confidence:.2f}"
        why = f"{begin}; {sum(pair.used for pair in own)} of {len(own)} registrations are used"
        return Scan(names[i], self._as_given(i, 0, graph.poses[i]), 0, confidence, why)

    def _moved(self, i: int, graph: Graph) -> Floats:
        """Return a scan in the frame of its root."""
        return self.clouds[i] @ graph.poses[i][:3, :3].T + graph.poses[i][:3, 3]

    def _as_given(self, source: int, target: int, matrix: Floats) -> RigidTransform:
        R = matrix[:3, :3]
        return check_transform(R, self.given[target].centre + matrix[:3, 3] - R @ self.given[source].centre, "register_sequence")

    def _edge(self, source: tuple[int, ...], target: tuple[int, ...], found: Registration) -> Edge:
        """Return the constraint. The information of groups is about another centre, and is left out."""
        scale = max(self.given[i].radius for i in source + target)
        information = found.information if len(source + target) == 2 else np.eye(6)
        return Edge(source[0], target[0], found.matrix, scale, information, found.confidence)


def _why(found: Registration, used: bool) -> str:
    if found.trusted:
        return "trusted" if used else "contradicts others that are trusted"
    return "not trusted, but others confirm it" if used else f"not trusted: {found.why}"
