"""Stanford models and range scans: `.conf` files, scans in one world frame, objects and recordings."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from cmig_jax.config import DataConfig
from cmig_jax.data.sources import open_objects, open_recordings


def recordings(folder: Path) -> list:
    return list(open_recordings(DataConfig(source="stanford-scans", root=str(folder))).recordings)


def write_two(folder: Path) -> np.ndarray:
    """Two scans of one cloud in the world frame, which is returned."""
    folder.mkdir(parents=True, exist_ok=True)
    world, shift = np.random.default_rng(0).uniform(-1, 1, (200, 3)), np.array([0.1, 0.2, -0.3])
    x, y, z, w = quaternion = np.array([0.1, -0.3, 0.2, 0.9]) / np.linalg.norm([0.1, -0.3, 0.2, 0.9])
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    trimesh.PointCloud(world).export(folder / "a.ply")
    trimesh.PointCloud((world - shift) @ np.transpose(rotation)).export(folder / "b.ply")
    numbers = " ".join(str(v) for v in (*shift, *quaternion))
    (folder / "toy.conf").write_text(f"camera 0 0 0 0 0 0 1\nbmesh a.ply 0 0 0 0 0 0 1\nbmesh b.ply {numbers}\n\n")
    return world


def test_scans_meet_in_the_world(tmp_path):
    world = write_two(tmp_path)
    one, two = recordings(tmp_path)
    assert (one.name, two.name) == ("toy/a", "toy/b")
    np.testing.assert_array_equal(one.world_from_sensor, np.eye(4))
    np.testing.assert_allclose(two.read() @ two.world_from_sensor[:3, :3].T + two.world_from_sensor[:3, 3], world, atol=1e-5)


def test_models_and_fused_scans_are_objects(tmp_path):
    world = write_two(tmp_path / "toy")
    (tmp_path / "models").mkdir()
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "models" / "box.ply")
    (tmp_path / "models" / "._box.ply").write_text("hidden")
    (tmp_path / "toy" / "._toy.conf").write_text("hidden")
    dataset = open_objects(DataConfig(source="stanford", root=str(tmp_path)))
    assert dataset.categories == ("scan",)
    assert [(item.name, item.split) for item in dataset.objects] == [("toy", "test"), ("models/box.ply", "test")]
    assert KDTree(dataset.objects[0].geometry()).query(world)[0].max() < 0.01
    assert dataset.objects[1].geometry().area == pytest.approx(22, rel=1e-5)


def test_every_conf_of_a_folder_is_an_object_also_with_one_below_it(tmp_path, scans):
    for folder, name in ((".", "cat"), (".", "zebra"), ("more", "dog")):  # sorted by path: cat.conf, more/dog.conf, zebra.conf
        scans.write(tmp_path / "animals" / folder, name)
    objects = open_objects(DataConfig(source="stanford", root=str(tmp_path / "animals"))).objects
    assert [item.name for item in objects] == ["animals/cat", "animals/zebra", "more"]


def test_every_conf_is_a_scene_and_its_scans_are_candidates(tmp_path, scans):
    scans.write(tmp_path)
    scans.write(tmp_path / "more", "cat")
    recorded = open_recordings(DataConfig(source="stanford-scans", root=str(tmp_path)))
    assert recorded.categories == ("more/cat", "toy")
    assert [item.name for item in recorded.recordings[3:5]] == ["more/cat/cat3", "toy/toy0"]
    assert [item.label for item in recorded.recordings] == [0] * 4 + [1] * 4
    assert len(recorded.candidates) == 12
    assert not any(i < 4 <= j for i, j in recorded.candidates)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("bmesh a.ply 0 0 0 0 0 1", r"line 1: .*expected bmesh FILE tx ty tz qx qy qz qw"),
        ("bmesh a.ply 0 0 0 0 0 zero 1", "line 1: .*zero"),
        ("bmesh a.ply 0 0 0 0 0 0 0", "line 1: .*norm"),
        ("bmesh a.ply 0 nan 0 0 0 0 1", "line 1: .*nan.*not finite"),
        ("bmesh c.ply 0 0 0 0 0 0 1", r"c\.ply: no such file"),
        ("camera 0 0 0 0 0 0 1", "no scans"),
    ],
)
def test_a_bad_conf_is_an_error(tmp_path, line, message):
    write_two(tmp_path)
    (tmp_path / "toy.conf").write_text(line + "\n")
    with pytest.raises(ValueError, match=message):
        recordings(tmp_path)


def test_real_scans_of_the_bunny_fit(tmp_path, real_data):
    folder = real_data("stanford_bunny_scans")
    lines = [line.split() for line in (folder / "bun.conf").read_text().splitlines()]
    few = [f"bmesh {folder / words[1]} {' '.join(words[2:])}" for words in lines if words and words[1][3:6] in ("000", "045", "315")]
    (tmp_path / "few.conf").write_text("\n".join(few))
    scans = {Path(scan.name).name: (scan.read(), scan.world_from_sensor) for scan in recordings(tmp_path)}
    world = {name: points @ pose[:3, :3].T + pose[:3, 3] for name, (points, pose) in scans.items()}
    for one, two in (("bun000", "bun045"), ("bun315", "bun000")):
        assert np.median(KDTree(world[two]).query(world[one])[0]) < 0.46e-3
