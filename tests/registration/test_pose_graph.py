"""Poses from registrations of pairs: loops are closed, what others contradict is left out, and conventions hold."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.registration.pose_graph import Edge, deviations, inverse, solve


def rigid(rng, angle=None, shift=1.0):
    turn = Rotation.from_quat(rng.normal(size=4)) if angle is None else Rotation.from_rotvec(angle * rng.normal(size=3))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), shift * rng.normal(size=3)
    return matrix


def scene(count, pairs, noise, seed=0):
    """Return poses `[n, 4, 4]`, first_from_scan, and measurements of pairs of scans that are off by some noise."""
    rng = np.random.default_rng(seed)
    poses = np.stack([np.eye(4), *(rigid(rng) for _ in range(count - 1))])
    edges = []
    for source, target in pairs:
        measured = inverse(poses[target]) @ poses[source] @ rigid(rng, noise, noise)
        edges.append(Edge(source, target, measured, 1.0, np.eye(6), 0.9))
    return poses, edges


def errors(poses, graph):
    return np.linalg.norm(deviations(poses, graph.poses, 1.0), axis=-1)


CHAIN = [(i + 1, i) for i in range(9)]


def test_a_chain_is_followed_exactly():
    poses, edges = scene(10, CHAIN, noise=0.0)
    graph = solve(10, edges)
    np.testing.assert_allclose(graph.poses, poses, atol=1e-12)
    np.testing.assert_array_equal(graph.root, 0)
    assert graph.used.all()


@pytest.mark.parametrize("closing", [(9, 0), (0, 9)])
def test_a_closed_loop_is_nearer_to_the_truth_than_a_chain(closing):
    chain, closed = [], []
    for seed in range(5):
        poses, edges = scene(10, [*CHAIN, closing], noise=0.01, seed=seed)
        chain.append(errors(poses, solve(10, edges[:-1])).max())
        closed.append(errors(poses, solve(10, edges)).max())
    assert np.mean(closed) < 0.75 * np.mean(chain)


def test_wrong_edges_among_many_are_left_out_although_they_are_more_confident():
    rng = np.random.default_rng(3)
    pairs = [*CHAIN, *((i + 2, i) for i in range(8))]
    poses, edges = scene(10, pairs, noise=0.005)
    wrong = [Edge(source, target, rigid(rng), 1.0, np.eye(6), 0.99) for source, target in ((0, 5), (2, 7), (8, 3))]
    graph = solve(10, [*wrong, *edges])
    assert graph.used.tolist() == [False] * 3 + [True] * len(edges)
    assert errors(poses, graph).max() < 0.05


def test_scans_that_nothing_connects_have_roots_of_their_own():
    poses, edges = scene(6, [(1, 0), (3, 2), (4, 3)], noise=0.0)
    graph = solve(6, [dataclasses.replace(edges[0], confidence=0.7), *edges[1:]])
    assert graph.root.tolist() == [0, 0, 2, 2, 2, 5]
    assert graph.confidence.tolist() == [1, 0.7, 1, 0.9, 0.9, 1]
    np.testing.assert_allclose(graph.relative(4, 2), inverse(poses[2]) @ poses[4], atol=1e-12)


def test_the_order_of_edges_and_the_choice_of_the_first_scan_do_not_matter():
    pairs = [(1, 0), (2, 1), (3, 2), (4, 3), (5, 4), (5, 0), (3, 0)]
    _, edges = scene(6, pairs, noise=0.01)
    graph = solve(6, edges)
    turned = [dataclasses.replace(edge, source=5 - edge.source, target=5 - edge.target) for edge in edges[::-1]]
    again = solve(6, turned)
    for source, target in pairs:
        off = deviations(graph.relative(source, target), again.relative(5 - source, 5 - target), 1.0)
        assert np.linalg.norm(off) < 1e-4
    backward = solve(6, [edge.reversed() for edge in scene(6, pairs, noise=0.0)[1]])
    np.testing.assert_allclose(backward.poses, scene(6, pairs, noise=0.0)[0], atol=1e-9)


def test_a_direction_that_an_edge_does_not_know_is_taken_from_the_others():
    """Scan 1 slid along x on a plane: its edge says so, and the way around it is exact."""
    poses, edges = scene(3, [(1, 0), (2, 1), (2, 0)], noise=0.0)
    slid = np.eye(4)
    slid[0, 3] = 0.04
    knows = np.diag([1.0, 1, 1, 1e-6, 1, 1])
    for information, largest, smallest in ((np.eye(6), 0.04, 0.005), (knows, 0.002, 0)):
        first = dataclasses.replace(edges[0], matrix=edges[0].matrix @ slid, information=information)
        assert smallest <= errors(poses, solve(3, [first, *edges[1:]])).max() < largest
