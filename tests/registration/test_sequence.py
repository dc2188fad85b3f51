"""A sequence of scans: all poses in one frame, which registrations they rest on, and which scans are left out."""

import itertools
import os
import time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig
from cmig_jax.data.sources.stanford import open_scans
from cmig_jax.registration import sequence
from cmig_jax.registration.clouds import user_cloud
from cmig_jax.registration.result import Registration
from cmig_jax.registration.scan_sequence import merge
from cmig_jax.registration.sequence import register_sequence
from cmig_jax.transform import RigidTransform


def body(count, seed):
    """Sample a sphere with bumps and dents that has no symmetry."""
    shape, rng = np.random.default_rng(3), np.random.default_rng(seed)
    towards, middles = rng.normal(size=(count, 3)), shape.normal(size=(12, 3))
    towards, middles = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (towards, middles))
    return towards * (1 + np.exp(8 * (towards @ middles.T - 1)) @ shape.uniform(-0.4, 0.6, 12))[:, None]


def moved(points, pose):
    return points @ pose[0].T + pose[1]


POSES = [(Rotation.from_quat(np.random.default_rng(i).normal(size=4)).as_matrix(), np.array([i, -2.0 * i, 5])) for i in range(6)]
"""scan_from_world of each scan."""


def first_from_scan(i, first=0):
    R = POSES[first][0] @ POSES[i][0].T
    return R, POSES[first][1] - R @ POSES[i][1]


class Oracle:
    """Stands for `register`: knows clouds by their number of points, and says of the pairs named whether they are trusted."""

    def __init__(self, scans, trusted, wrong=(), confidence=0.9):
        self.groups = {
            sum(len(scans[i]) for i in group): group for n in range(1, 7) for group in itertools.combinations(range(len(scans)), n)
        }
        self.centres = [user_cloud(scan, "scan").centre for scan in scans]
        self.trusted, self.wrong, self.confidence, self.asked = trusted, wrong, confidence, []

    def __call__(self, source, target, network, rotations, up):
        a, b = self.groups[len(source)], self.groups[len(target)]
        pair = tuple(sorted((a, b)))
        self.asked.append((pair[0] + pair[1], rotations))
        R, t = first_from_scan(a[0], b[0])
        t = t + R @ self.centres[a[0]] - self.centres[b[0]]  # `register_sequence` gives clouds about their own centres
        if pair[0] + pair[1] in self.wrong:
            R = R @ Rotation.from_euler("z", 100, degrees=True).as_matrix()
        trusted = pair[0] + pair[1] in self.trusted
        return Registration(
            target_from_source=RigidTransform(R=R, t=t),
            trusted=trusted,
            why="aligned" if trusted else "no pose fits",
            confidence=self.confidence if trusted else 0.2,
            overlap=(0.5, 0.5),
            inlier_rmse=0.01,
            correspondences=np.zeros((0, 2), np.int64),
            information=np.eye(6),
            alternatives=(),
            dropped=(0, 0),
            seconds={},
        )


@pytest.fixture
def scans():
    return [moved(body(60 + 2**i, i), POSES[i]) for i in range(6)]


@pytest.fixture
def ask(monkeypatch, scans):
    """Register the scans by an oracle that trusts some pairs."""

    def run(trusted, wrong=(), count=6, **options):
        oracle = Oracle(scans[:count], set(trusted), set(wrong))
        monkeypatch.setattr(sequence, "register", oracle)
        return register_sequence(scans[:count], **options), oracle

    return run


def assert_right(found, placed, first=0):
    for i in placed:
        R, t = first_from_scan(i, first)
        np.testing.assert_allclose(found.scans[i].pose.R, R, atol=1e-6)
        np.testing.assert_allclose(found.scans[i].pose.t, t, atol=1e-5)


def test_poses_take_each_scan_into_the_frame_of_the_first(ask):
    found, oracle = ask([(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)])
    assert_right(found, range(6))
    assert found.trusted
    np.testing.assert_allclose(found.scans[0].pose.as_matrix(), np.eye(4), atol=1e-12)
    assert {pair for pair, _ in oracle.asked} == set(itertools.combinations(range(6), 2))
    pair = next(pair for pair in found.pairs if {*pair.source, *pair.target} == {2, 4})
    R, t = first_from_scan(pair.source[0], pair.target[0])
    np.testing.assert_allclose(pair.target_from_source.R, R, atol=1e-9)
    np.testing.assert_allclose(pair.target_from_source.t, t, atol=1e-9)


def test_registrations_that_are_not_trusted_are_used_where_the_others_confirm_them(ask):
    found, _ = ask([(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)], wrong=[(0, 3), (1, 5)])
    why = {tuple(sorted(pair.source + pair.target)): (pair.used, pair.why) for pair in found.pairs}
    assert why[0, 1] == (True, "trusted")
    assert why[0, 2] == (True, "not trusted, but others confirm it")
    assert why[0, 3] == why[1, 5] == (False, "not trusted: no pose fits")
    assert_right(found, range(6))


def test_a_trusted_registration_that_the_others_contradict_is_not_used(ask):
    found, _ = ask([(0, 1), (1, 2), (0, 2), (2, 3), (1, 3), (0, 3), (0, 4), (4, 5), (0, 5)], wrong=[(0, 3)])
    assert_right(found, range(6))
    pair = next(pair for pair in found.pairs if pair.trusted and not pair.used)
    assert {*pair.source, *pair.target} == {0, 3}
    assert pair.why == "contradicts others that are trusted"


def test_a_scan_that_nothing_connects_is_named_and_left_out(ask, scans):
    found, _ = ask([(0, 1), (1, 2), (2, 3), (3, 5)], names=[f"{i}.ply" for i in range(6)])
    assert [scan.pose is None for scan in found.scans] == [False, False, False, False, True, False]
    assert not found.trusted
    assert "4.ply: left out: no trusted registration connects it to 0.ply (6 were tried)" in str(found)
    assert "5 of 6 scans in one frame" in str(found)
    assert_right(found, (0, 1, 2, 3, 5))
    merged = found.merged(scans, cell=1e-3)
    assert len(merged) == sum(len(scan) for i, scan in enumerate(scans) if i != 4)
    with pytest.raises(ValueError, match="shorter"):
        found.merged(scans[:3])


def test_where_the_first_scan_is_the_odd_one_another_first_is_named(ask):
    found, _ = ask([(1, 2), (2, 3), (3, 4), (4, 5)])
    assert [scan.group for scan in found.scans] == [0, 1, 1, 1, 1, 1]
    assert "5 scans fit each other and not the first: give scan 1 first" in str(found)


def test_groups_are_registered_as_one_cloud(ask):
    """No pair across is trusted, but the union is."""
    found, _ = ask([(0, 1), (2, 3), (0, 1, 2, 3)], count=4)
    assert_right(found, range(4))
    assert found.pairs[-1].source == (2, 3)
    assert found.pairs[-1].target == (0, 1)
    assert not ask([(0, 1), (2, 3)], count=4)[0].trusted


def test_of_many_scans_those_that_overlap_by_their_poses_are_registered(monkeypatch, ask, scans):
    """Patches of a ring: each overlaps its neighbours, and the last the first."""
    rng = np.random.default_rng(0)
    for i, scan in enumerate(scans):
        angle, height = np.pi / 3 * (i + rng.uniform(-0.85, 0.85, 400 + len(scan))), rng.uniform(-0.3, 0.3, 400 + len(scan))
        scans[i] = moved(np.stack([np.cos(angle), np.sin(angle), height], axis=1), POSES[i])
    monkeypatch.setattr(sequence, "ALL_PAIRS_UP_TO", 5)
    neighbours = [(i, i + 1) for i in range(5)]
    found, oracle = ask([*neighbours, (0, 5)])
    assert [pair for pair, _ in oracle.asked[5:]] == [(0, 5)]
    assert {pair for pair, _ in oracle.asked[:5]} == set(neighbours)
    assert_right(found, range(6))


def test_a_bound_on_the_rotation_holds_between_neighbours_only(ask):
    _, oracle = ask([(0, 1), (1, 2), (2, 3)], count=4, rotations=50)
    limits = dict(oracle.asked)
    assert [limits[i, i + 1] for i in range(3)] == [50, 50, 50]
    assert {limit for pair, limit in limits.items() if pair not in [(0, 1), (1, 2), (2, 3)]} == {"any"}
    assert {limit for _, limit in ask([], count=4, rotations="yaw")[1].asked} == {"yaw"}


def test_what_is_no_sequence_is_refused(scans):
    with pytest.raises(ValueError, match="1 scans; expected at least two"):
        register_sequence(scans[:1])
    with pytest.raises(ValueError, match=r"b\.ply: 3 .*points; expected at least"):
        register_sequence([scans[0], scans[1][:3]], names=["a.ply", "b.ply"])
    with pytest.raises(ValueError, match="rotations = 200: expected"):
        register_sequence(scans[:2], rotations=200)


def view(direction, seed, count=500, share=0.7):
    """Return the points of the body that lie farthest in a direction."""
    points = body(round(count / share), seed)
    return points[np.argsort(-points @ direction)[:count]]


def test_views_of_a_body_are_put_together_in_any_order_and_a_foreign_scan_is_not():
    directions = np.array([[1, 0, 0.5], [0.2, 1, 0.4], [-1, 0.2, 0.3], [-0.2, -1, 0.4]])
    views = [moved(view(direction, i), POSES[i]) for i, direction in enumerate(directions)]
    foreign = np.random.default_rng(9).normal(size=(500, 3))
    found = register_sequence([*views, foreign / np.linalg.norm(foreign, axis=1, keepdims=True)])
    for i in range(4):
        R, t = first_from_scan(i)
        pose = found.scans[i].pose
        assert pose is not None
        assert np.degrees(RigidTransform(R=pose.R @ R.T, t=t).angle()) < 2
        centre = views[i].mean(axis=0)
        assert np.linalg.norm(pose.apply(centre[None])[0] - R @ centre - t) < 0.02
    assert found.scans[4].pose is None
    again = register_sequence(views[::-1])
    for i in range(4):
        pose, other = again.scans[3 - i].pose, again.scans[3].pose
        assert pose is not None
        assert other is not None
        np.testing.assert_allclose(other.inverse().compose(pose).as_matrix(), found.scans[i].pose.as_matrix(), atol=0.01)


def test_merged_clouds_have_one_mean_per_cell():
    one = np.array([[0.1, 0.1, 0.1, 10], [0.3, 0.1, 0.1, 20], [5.1, 0.1, 0.1, 30]])
    two = np.array([[0.4, 0.3, 0.1, 45]])
    np.testing.assert_allclose(merge([one, two], cell=1.0), [[0.3, 0.2, 0.1, 30], [5.1, 0.1, 0.1, 30]])
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(20), [0.0]), axis=-1).reshape(-1, 3)
    assert len(merge([grid, grid + 1e-3])) == 400, "by default, cells are as wide as the points are apart"


@pytest.mark.slow
@pytest.mark.skipif("CMIG_SCANS" not in os.environ, reason="CMIG_SCANS names no folder of range scans with their .conf")
@pytest.mark.parametrize("shuffled", [False, True])
def test_recorded_scans_are_put_together_within_two_degrees_and_one_percent(shuffled):
    """`CMIG_SCANS=DIR pytest -m slow -s tests/registration/test_sequence.py` prints the errors of each scan."""
    recordings = open_scans(DataConfig(source="stanford-scans", root=os.environ["CMIG_SCANS"])).recordings
    recordings = [recordings[i] for i in (np.random.default_rng(0).permutation(len(recordings)) if shuffled else range(len(recordings)))]
    clouds, world = [recording.read().astype(np.float64) for recording in recordings], [one.world_from_sensor for one in recordings]
    begin = time.perf_counter()
    found = register_sequence(clouds, names=[recording.name for recording in recordings])
    print(f"\n{time.perf_counter() - begin:.0f} s; {str(found).splitlines()[-1]}")
    whole = np.concatenate([moved(cloud, (pose[:3, :3], pose[:3, 3])) for cloud, pose in zip(clouds, world, strict=True)])
    size = np.linalg.norm(np.ptp(whole, axis=0))
    for scan, cloud, pose in zip(found.scans, clouds, world, strict=True):
        truth = RigidTransform.from_matrix(np.linalg.inv(world[0]) @ pose)
        assert scan.pose is not None
        degrees = np.degrees(scan.pose.compose(truth.inverse()).angle())
        percent = 100 * np.linalg.norm((scan.pose.apply(cloud) - truth.apply(cloud)).mean(axis=0)) / size
        print(f"{scan.name}: {degrees:.2f} degrees, {percent:.3f} %")
        assert degrees < 2
        assert percent < 1
