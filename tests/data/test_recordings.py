"""Recorded pairs: what overlaps, the transform between, and what a network is given of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cmig_jax.config import Config, DataConfig, KeypointsConfig, ModelConfig, PointsConfig, ViewsConfig
from cmig_jax.data.pairs import render_clouds
from cmig_jax.data.prepare import ensure_prepared
from cmig_jax.data.recorded_pairs import RecordedPairs
from cmig_jax.data.recordings import MANIFEST, OVERLAP, between, ensure_recordings, open_recordings, overlap

POSES = [Rotation.from_euler("zyx", [angle, 5 * k, 0], degrees=True) for k, angle in enumerate((0, 30, 100, 0))]
SHIFTS = np.array([[0, 0, 0], [0.1, 0.2, -0.3], [5, 0, 1], [2, 2, 2]])
WORLD = np.random.default_rng(0).normal(size=(3000, 3)) * [1, 0.6, 0.3]
WORLD = WORLD[WORLD[:, 0].argsort()]  # so that a scan is what lies between two planes
# Scans 0 and 1 share two thirds, 1 and 2 half, 0 and 2 a sixth; 3 shares nothing.
PARTS = [slice(0, 1200), slice(400, 1600), slice(1000, 2200), slice(2200, 3000)]


def write_scans(folder: Path, name: str = "toy", unit: float = 1.0) -> Path:
    """Scans of one cloud, and the `.conf` with x_world = R^T x + t."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["camera 0 0 0 0 0 0 1"]
    for k, (rotation, shift, part) in enumerate(zip(POSES, SHIFTS, PARTS, strict=True)):
        trimesh.PointCloud(unit * (WORLD[part] - shift) @ rotation.as_matrix().T).export(folder / f"{name}{k}.ply")
        lines.append(f"bmesh {name}{k}.ply {' '.join(map(str, (*unit * shift, *rotation.as_quat())))}")
    (folder / f"{name}.conf").write_text("\n".join(lines) + "\n")
    return folder


def config(data: DataConfig, **views) -> Config:
    return Config(
        data=data,
        views=ViewsConfig(**{"of": "both", "count": 6, "size": 16, "layout": "axes"} | views),
        model=ModelConfig(points=PointsConfig(k=4), keypoints=KeypointsConfig(count=16)),
    )


@pytest.fixture
def data(tmp_path) -> DataConfig:
    """Scans, and flags that keep every pair of them and every point."""
    root = write_scans(tmp_path / "scans")
    return DataConfig(source="stanford-scans", root=str(root), prepared=str(tmp_path / "out"), points=1200, crop="none", max_angle_deg=180)


def pairs_of(data: DataConfig, limit: int | None = None, **views) -> RecordedPairs:
    return RecordedPairs(ensure_recordings(data, progress=False), config(data, **views), limit=limit)


def test_pairs_are_those_that_overlap_in_either_order(data):
    pairs = pairs_of(data)
    assert pairs.names == tuple(f"toy/toy{i} to toy/toy{j}" for i, j in ((0, 1), (1, 0), (1, 2), (2, 1)))
    assert pairs.categories == ("toy",)
    shares = [float(pair["overlap"]) for pair in pairs]
    assert shares == pytest.approx([2 / 3, 2 / 3, 1 / 2, 1 / 2], abs=0.1)
    assert min(shares) >= OVERLAP
    assert [int(pair["index"]) for pair in pairs] == [0, 1, 2, 3]


def test_the_true_transform_brings_the_shared_points_together(data):
    for pair in pairs_of(data):
        moved = pair["source"] @ pair["R"].T + pair["t"]
        nearest = KDTree(pair["target"]).query(moved)[0]
        assert np.mean(nearest < 1e-5) == pytest.approx(float(pair["overlap"]), abs=0.1)
        assert KDTree(pair["target"]).query(pair["source"])[0].min() > 1e-5
        assert pair["R"].dtype == pair["source"].dtype == np.float32
        assert "object" not in pair


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_clouds_are_centred_each_and_scaled_together_as_registration_does(tmp_path, data, unit):
    data = replace(data, root=str(write_scans(tmp_path / "other", unit=unit)), prepared=str(tmp_path / "other-out"))
    pair = pairs_of(data)[0]
    x, y = (unit * (WORLD[PARTS[k]] - SHIFTS[k]) @ POSES[k].as_matrix().T for k in (0, 1))
    scale = max(np.linalg.norm(cloud - cloud.mean(0), axis=1).max() for cloud in (x, y))
    for cloud, found in ((x, pair["source"]), (y, pair["target"])):
        expected = (cloud - cloud.mean(0)) / scale
        np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.astype(np.float32).T)], atol=1e-5)
    t = y.mean(0) + scale * pair["t"] - pair["R"] @ x.mean(0)  # back in the units of the scans
    R = POSES[1].as_matrix() @ POSES[0].as_matrix().T
    np.testing.assert_allclose(pair["R"], R, atol=1e-5)
    np.testing.assert_allclose(t, unit * POSES[1].as_matrix() @ (SHIFTS[0] - SHIFTS[1]), atol=1e-4 * unit)


def test_a_pair_has_the_points_of_a_cropped_pair_and_does_not_depend_on_the_limit(data):
    data = replace(data, points=400, crop="shared", keep=0.75)
    pairs, few = pairs_of(data), pairs_of(data, limit=2)
    assert (len(few), few.names) == (2, (pairs.names[0], pairs.names[3]))
    assert pairs[0]["source"].shape == pairs[0]["target"].shape == (300, 3)
    for name, value in pairs[3].items():
        np.testing.assert_array_equal(few[1][name], value)
        np.testing.assert_array_equal(pairs[-1][name], value)
    assert not np.array_equal(pairs_of(replace(data, test_seed=5))[3]["source"], pairs[3]["source"])
    with pytest.raises(IndexError):
        pairs[4]
    with pytest.raises(ValueError, match=r"toy/toy0 has 1200 points: expected at least 1201, of data\.points and data\.keep"):
        pairs_of(replace(data, points=1201, crop="none"))[0]


def test_pairs_that_turn_too_far_are_left_out_and_the_others_stay_the_same(data):
    pairs, near = pairs_of(data), pairs_of(replace(data, max_angle_deg=45.0))
    assert near.names == pairs.names[:2]
    np.testing.assert_array_equal(near[1]["target"], pairs[1]["target"])
    with pytest.raises(ValueError, match=r"data\.max_angle_deg = 20.*turn by at least 30\.\d degrees"):
        pairs_of(replace(data, max_angle_deg=20.0))


def test_views_are_rendered_from_what_is_observed_or_of_another_pair_or_black(data):
    pair, shuffled, zero = (pairs_of(data, shown=shown)[1] for shown in ("real", "shuffled", "zero"))
    np.testing.assert_array_equal(pair["views"], render_clouds(pair, config(data).views))
    for other in (shuffled, zero):
        assert all(np.array_equal(pair[name], other[name]) for name in pair if name != "views")
        assert not np.array_equal(other["views"], pair["views"])
        assert not np.array_equal(other["views"], pair["views"][::-1])  # nor those of the same two clouds, exchanged
    assert (zero["views"].shape, zero["views"].any()) == ((2, 6, 16, 16), False)
    np.testing.assert_array_equal(shuffled["views"], pairs_of(data, shown="shuffled")[1]["views"])
    with pytest.raises(ValueError, match=r"views\.of = object with data\.source = stanford-scans: .* expected views\.of = source"):
        pairs_of(data, of="object")


def test_a_preparation_continues_where_it_stopped(data, tmp_path):
    missing = tmp_path / "scans" / "toy2.ply"
    content = missing.read_bytes()
    missing.write_bytes(content[:300])
    with pytest.raises(ValueError, match=r"toy2\.ply: not a readable PLY"):
        pairs_of(data)
    done = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    assert len(done) == 2
    missing.write_bytes(content)
    assert len(pairs_of(data)) == 4
    assert {path: path.stat().st_mtime_ns for path in done} == done
    assert sorted(path.suffix for path in (tmp_path / "out").iterdir()) == [".json", ".npy", ".npy", ".npy", ".npy"]


def test_scans_of_several_files_are_several_scenes(data, tmp_path):
    write_scans(tmp_path / "scans" / "more", "cat")
    recorded = open_recordings(data)
    assert recorded.categories == ("more/cat", "toy")
    assert [item.label for item in recorded.recordings] == [0] * 4 + [1] * 4
    assert (0, 1) in recorded.candidates
    assert not any(i < 4 <= j for i, j in recorded.candidates)


def test_what_is_damaged_or_of_another_source_is_named(data, tmp_path):
    pairs = pairs_of(data)
    cloud = next((tmp_path / "out").glob("toy-toy0-*.npy"))
    cloud.write_bytes(cloud.read_bytes()[:500])
    with pytest.raises(ValueError, match=rf"{cloud.name}: not readable .* delete it"):
        pairs[0]
    with pytest.raises(ValueError, match=r"data\.source = sevenscenes-fragments, but .* was prepared with data\.source = stanford-scans"):
        ensure_recordings(replace(data, source="sevenscenes-fragments"))
    for text in ("{}", '{"format": 1}'):
        (tmp_path / "out" / MANIFEST).write_text(text)
        with pytest.raises(ValueError, match=r"pairs\.json: expected a manifest of format 1"):
            pairs_of(data)
    (tmp_path / "out" / MANIFEST).write_text("{")
    with pytest.raises(ValueError, match=r"pairs\.json: not readable"):
        pairs_of(data)


@pytest.mark.parametrize("source", ["stanford-scans", "sevenscenes-fragments"])
def test_a_wrong_root_is_an_error_and_so_is_training(source, tmp_path):
    for root, message in ((None, r"data\.root = None: expected"), ("nowhere", "no such folder; expected"), (tmp_path, "no .*expected")):
        with pytest.raises(ValueError, match=message):
            ensure_recordings(DataConfig(source=source, root=root and str(root)))
    with pytest.raises(ValueError, match=rf"{source} has recorded pairs, no objects: it is for evaluation only .*evaluate\.py"):
        ensure_prepared(config(DataConfig(source=source, root=str(tmp_path))))
    with pytest.raises(ValueError, match=r"data\.source = shapes: expected stanford-scans or sevenscenes-fragments"):
        ensure_recordings(DataConfig(source="shapes", prepared=str(tmp_path / "out")))


def test_scans_that_do_not_overlap_are_no_pairs(data, tmp_path):
    conf = tmp_path / "scans" / "toy.conf"
    lines = conf.read_text().splitlines()
    conf.write_text("\n".join([lines[1], lines[4]]))
    with pytest.raises(ValueError, match=r"none of 1 candidate pairs of 2 recordings overlaps by 0\.3"):
        pairs_of(data)


def test_overlap_is_the_smaller_share_and_near_is_relative():
    line = np.linspace(0, 1, 2001)[:, None] * [1.0, 0, 0]
    half = line[:1001]
    for unit in (1.0, 50.0):
        assert overlap(unit * half, unit * line, np.eye(4)) == pytest.approx(0.51, abs=0.01)  # half, and 0.02 of the radius 0.5
        assert overlap(unit * line, unit * half, np.eye(4)) == pytest.approx(0.51, abs=0.01)
    shifted = np.eye(4)
    shifted[0, 3] = 5
    assert overlap(half, line, shifted) == 0


def test_a_transform_between_is_rigid():
    poses = []
    for k in range(2):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = POSES[k + 1].as_matrix(), SHIFTS[k + 1]
        poses.append(pose)
    point = np.array([0.3, -0.2, 0.9, 1.0])
    np.testing.assert_allclose(poses[1] @ between(*poses) @ point, poses[0] @ point, atol=1e-12)
    poses[0][:3, :3] += 1e-4
    R = between(*poses)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    for bad in (np.diag([2.0, 1, 1, 1]), np.diag([-1.0, 1, 1, 1])):
        with pytest.raises(ValueError, match="expected a rotation and a translation"):
            between(bad, np.eye(4))


def camera(i: int) -> np.ndarray:
    """A pose that turns and walks along a wall."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 0.2 * i, degrees=True).as_matrix()
    pose[:3, 3] = (0.004 * i, 0.002 * i, 0.3)
    return pose


def write_frames(folder: Path, count: int) -> None:
    """Frames that look at a wall with a step in it, z = 2 or 2.3 m of the world."""
    folder.mkdir(parents=True)
    v, u = np.mgrid[:24, :32]
    rays = np.stack([(u - 16) / 20, (v - 12) / 20, np.ones(u.shape)], -1)
    for i in range(count):
        pose = camera(i)
        turned = rays @ pose[:3, :3].T
        far, near = ((wall - pose[2, 3]) / turned[..., 2] for wall in (2.3, 2.0))
        depth = np.where(pose[0, 3] + near * turned[..., 0] > 0.2, near, far)
        Image.fromarray(np.round(depth * 1000).astype(np.uint16)).save(folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)


def test_neighbouring_fragments_of_the_held_out_scene_are_pairs(tmp_path):
    for place, count in (("scenes/office/seq-01", 150), ("scenes/office/seq-02", 100), ("scenes/chess/seq-01", 100)):
        write_frames(tmp_path / place, count)
    np.savetxt(tmp_path / "scenes" / "camera-intrinsics.txt", [[20.0, 0, 16], [0, 20, 12], [0, 0, 1]])
    data = DataConfig(
        source="sevenscenes-fragments", root=str(tmp_path / "scenes"), prepared=str(tmp_path / "out"), points=400, crop="none"
    )
    pairs = pairs_of(data)
    assert pairs.categories == ("chess", "office")
    assert {int(pair["label"]) for pair in pairs} == {1}
    one, two = "office/seq-01/fragment-", "office/seq-02/fragment-"
    expected = [(one, 0, 1), (one, 1, 0), (one, 1, 2), (one, 2, 1), (two, 0, 1), (two, 1, 0)]
    assert pairs.names == tuple(f"{name}{i:03d} to {name}{j:03d}" for name, i, j in expected)
    for (_, i, j), pair in zip(expected, pairs, strict=True):
        np.testing.assert_allclose(pair["R"], (np.linalg.inv(camera(50 * j)) @ camera(50 * i))[:3, :3], atol=1e-6)
        moved = pair["source"] @ pair["R"].T + pair["t"]
        assert np.median(KDTree(pair["target"]).query(moved)[0]) < 0.6 * np.median(KDTree(pair["target"]).query(pair["source"])[0])


def test_fragments_without_poses_are_refused(tmp_path):
    trimesh.PointCloud(WORLD).export(tmp_path / "cloud_bin_0.ply")
    with pytest.raises(ValueError, match=r"cloud_bin_0\.ply: a fragment without its pose; expected frame-"):
        open_recordings(DataConfig(source="sevenscenes-fragments", root=str(tmp_path)))


def test_the_kitchen_s_transform_is_the_official_one(real_data):
    recorded = open_recordings(DataConfig(source="sevenscenes-fragments", root=str(real_data("sevenscenes_redkitchen"))))
    zero, one = (item.world_from_sensor for item in recorded.recordings)
    zero_from_one = [
        [0.996926560, 0.0668735757, -0.0406664421, -0.115576939],
        [-0.0661289946, 0.997617877, 0.0194008687, -0.0387705398],
        [0.0418675510, -0.0166517807, 0.998977765, 0.114874890],
        [0, 0, 0, 1],
    ]
    np.testing.assert_allclose(between(one, zero), zero_from_one, atol=1e-5)
    assert recorded.candidates == ((0, 1),)


def test_two_scans_of_the_bunny_make_two_pairs(tmp_path, real_data):
    folder = real_data("stanford_bunny_scans")
    lines = [line.split() for line in (folder / "bun.conf").read_text().splitlines()]
    few = [f"bmesh {folder / words[1]} {' '.join(words[2:])}" for words in lines if words[1:2] in (["bun000.ply"], ["bun045.ply"])]
    (tmp_path / "bunny.conf").write_text("\n".join(few))
    data = DataConfig(source="stanford-scans", root=str(tmp_path), prepared=str(tmp_path / "out"), points=20000, crop="none")
    pairs = pairs_of(data)
    assert pairs.names == ("bunny/bun000 to bunny/bun045", "bunny/bun045 to bunny/bun000")
    pair = pairs[0]
    assert float(pair["overlap"]) > 0.85
    assert np.degrees(Rotation.from_matrix(pair["R"]).magnitude()) == pytest.approx(34.3, abs=0.1)
    moved = pair["source"] @ pair["R"].T + pair["t"]
    assert np.median(KDTree(pair["target"]).query(moved)[0]) < 0.01
