"""7-Scenes: depth frames fused into fragments, objects of scenes, and recordings of the test scenes."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import KDTree

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.pairs import Pairs
from cmig_jax.data.prepare import prepare
from cmig_jax.data.recordings import between
from cmig_jax.data.shards import Shards
from cmig_jax.data.sources import open_objects, open_recordings

ZERO_FROM_ONE = np.array(
    [
        [0.996926560, 0.0668735757, -0.0406664421, -0.115576939],
        [-0.0661289946, 0.997617877, 0.0194008687, -0.0387705398],
        [0.0418675510, -0.0166517807, 0.998977765, 0.114874890],
        [0, 0, 0, 1],
    ]
)
"""The official transform between the first two fragments of the kitchen."""


def opened(root: Path):
    return open_objects(DataConfig(source="sevenscenes", root=str(root)))


def test_fragments_lie_in_the_frame_of_their_first_camera(tmp_path, frames):
    frames.write(tmp_path / "wall", 130)
    np.savetxt(tmp_path / "camera-intrinsics.txt", frames.intrinsics)
    objects = opened(tmp_path / "wall").objects
    assert [item.name for item in objects] == [f"wall/fragment-{i:03d}" for i in range(3)]
    assert {item.split for item in objects} == {"test"}
    for item, first in zip(objects, (0, 50, 100), strict=True):
        points, pose = pickle.loads(pickle.dumps(item)).geometry(), frames.camera(first)
        depth = (points @ pose[:3, :3].T + pose[:3, 3])[:, 2]
        np.testing.assert_allclose(depth, np.where(depth < 2.15, 2.0, 2.3), atol=0.003)
        assert {2.0, 2.3} == set(np.round(depth, 1))
        assert np.median(KDTree(points).query(points, k=2)[0][:, 1]) < 0.05
        assert len(points) < 50 * 23 * 31


def test_scenes_are_categories_and_the_office_is_held_out(tmp_path, frames):
    for scene, count in (("chess", 3), ("office", 4), ("stairs", 60)):
        frames.write(tmp_path / scene / "seq-01", count)
    (tmp_path / "red").mkdir()
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(9, 3))).export(tmp_path / "red" / "cloud_bin_0.ply")
    (tmp_path / "red" / "._cloud_bin_0.ply").write_text("hidden")
    dataset = opened(tmp_path)
    assert dataset.categories == ("chess", "office", "red", "stairs")
    assert [(item.name, item.split, item.label) for item in dataset.objects] == [
        ("chess/seq-01/fragment-000", "train", 0),
        ("red/cloud_bin_0.ply", "train", 2),
        ("stairs/seq-01/fragment-000", "train", 3),
        ("office/seq-01/fragment-000", "test", 1),
    ]
    assert dataset.objects[1].geometry().shape == (9, 3)


@pytest.mark.parametrize("of", ["object", "both"])
def test_the_protocol_of_the_paper(tmp_path, of):
    """Table 5: six scenes train and the Office tests; 2,048 points of a fragment, 1,536 after the crop."""
    rng = np.random.default_rng(0)
    for scene in ("chess", "fire", "heads", "office", "pumpkin", "redkitchen", "stairs"):
        (tmp_path / "raw" / scene).mkdir(parents=True)
        for i in range(2):
            trimesh.PointCloud(rng.normal(size=(5000, 3)) * [2.0, 1.2, 1.5] + [0.5, 0.2, 3.0]).export(tmp_path / "raw" / scene / f"{i}.ply")
    trimesh.creation.box((2, 1, 3)).export(tmp_path / "raw" / "office" / "1.ply")
    data = DataConfig(source="sevenscenes", root=str(tmp_path / "raw"), points=2048, keep=0.75, noise_std=0.0)
    views = ViewsConfig(of=of, count=6, size=24, layout="axes")
    folder = prepare(data, views, tmp_path / "out", workers=1, progress=False)
    train, test = Shards(folder, "train"), Shards(folder, "test")
    assert (len(train), len(test)) == (12, 2)
    assert {test.categories[label] for label in test.labels} == {"office"}
    assert "office" not in {train.categories[label] for label in train.labels}
    for pair in Pairs(test, np.arange(2), data, views, 0):
        assert pair["source"].shape == pair["target"].shape == (1536, 3)
        assert pair["views"].shape == ((1 if of == "object" else 2), 6, 24, 24)
        assert pair["views"].any(axis=(2, 3)).all()


def spoil_png(folder: Path) -> None:
    path = folder / "frame-000001.depth.png"
    path.write_bytes(path.read_bytes()[:60])


def eight_bits(folder: Path) -> None:
    Image.fromarray(np.zeros((24, 32), np.uint8)).save(folder / "frame-000001.depth.png")


def no_depth(folder: Path) -> None:
    for path in folder.glob("*.png"):
        Image.fromarray(np.full((24, 32), 65535, np.uint16)).save(path)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: (folder / "frame-000001.pose.txt").unlink(), r"frame-000001\.pose\.txt: no such file"),
        (lambda folder: (folder / "frame-000001.pose.txt").write_text("1 2\n3 4\n"), r"pose\.txt: .*expected an invertible \[4, 4\]"),
        (lambda folder: np.savetxt(folder / "frame-000001.pose.txt", np.eye(4) * np.nan), r"pose\.txt: .*finite"),
        (lambda folder: (folder / "frame-000001.pose.txt").write_text("lost\n"), r"pose\.txt: not a readable matrix"),
        (spoil_png, r"frame-000001\.depth\.png: not a readable PNG"),
        (eight_bits, r"depth\.png: pixels of shape \(24, 32\), uint8"),
        (no_depth, "no depth in 3 frames"),
        (lambda folder: (folder / "camera-intrinsics.txt").write_text("585 585 320 240\n"), r"intrinsics\.txt: .*expected an invertible"),
    ],
)
def test_a_bad_frame_is_an_error(tmp_path, frames, spoil, message):
    frames.write(tmp_path / "wall", 3)
    spoil(tmp_path / "wall")
    with pytest.raises(ValueError, match=message):
        opened(tmp_path / "wall").objects[0].geometry()


def test_fragments_without_poses_are_refused_as_recordings(tmp_path):
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(9, 3))).export(tmp_path / "cloud_bin_0.ply")
    with pytest.raises(ValueError, match=r"cloud_bin_0\.ply: a fragment without its pose; expected frame-"):
        open_recordings(DataConfig(source="sevenscenes-fragments", root=str(tmp_path)))


def test_the_transform_of_the_real_kitchen_is_the_official_one(real_data):
    recorded = open_recordings(DataConfig(source="sevenscenes-fragments", root=str(real_data("sevenscenes_redkitchen"))))
    zero, one = (item.world_from_sensor for item in recorded.recordings)
    np.testing.assert_allclose(between(one, zero), ZERO_FROM_ONE, atol=1e-5)
    assert recorded.candidates == ((0, 1),)


def test_real_fragments_of_the_kitchen_meet(tmp_path, real_data):
    # Every tenth frame keeps the test short; the links keep fragment 0 to frames 0-49 and put fragment 1 in frame 50.
    folder = real_data("sevenscenes_redkitchen")
    for part, numbers in (("a", range(0, 50, 10)), ("b", range(50, 100, 10))):
        (tmp_path / part).mkdir()
        for number in numbers:
            for kind in ("depth.png", "pose.txt"):
                (tmp_path / part / f"frame-{number:06d}.{kind}").symlink_to(folder / f"frame-{number:06d}.{kind}")
    zero, one = (opened(tmp_path / part).objects[0].geometry() for part in ("a", "b"))
    tree = KDTree(zero)
    aligned = tree.query((one @ ZERO_FROM_ONE[:3, :3].T + ZERO_FROM_ONE[:3, 3])[::20])[0]
    assert np.median(aligned) < 0.015
    assert np.median(tree.query(one[::20])[0]) > 3 * np.median(aligned)
