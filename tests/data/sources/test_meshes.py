"""A folder of meshes or clouds by category."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cmig_jax.config import DataConfig
from cmig_jax.data.geometry_files import read_geometry, write_moved
from cmig_jax.data.sources import open_objects


def opened(root: Path):
    return open_objects(DataConfig(source="meshes", root=str(root)))


def test_folders_with_splits(tmp_path):
    for category in ("lamp", "bowl"):
        for split, count in (("train", 3), ("test", 2)):
            (tmp_path / category / split).mkdir(parents=True)
            for i in range(count):
                trimesh.creation.box((i + 1, 2, 3)).export(tmp_path / category / split / f"{category}_{i}.off")
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / "README.txt").write_text("not an object")
    (tmp_path / "bowl" / "train" / "._bowl_0.off").write_text("not an object either")
    dataset = opened(tmp_path)
    assert dataset.categories == ("bowl", "lamp")
    assert [(item.name, item.label, item.split) for item in dataset.objects[2:8]] == [
        ("bowl/train/bowl_2.off", 0, "train"),
        ("lamp/train/lamp_0.off", 1, "train"),
        ("lamp/train/lamp_1.off", 1, "train"),
        ("lamp/train/lamp_2.off", 1, "train"),
        ("bowl/test/bowl_0.off", 0, "test"),
        ("bowl/test/bowl_1.off", 0, "test"),
    ]
    assert not any(item.shuffled for item in dataset.objects)
    assert dataset.objects[4].geometry().extents[0] == pytest.approx(2)
    (tmp_path / "lamp" / "test" / "lamp_0.off").unlink()
    (tmp_path / "lamp" / "test" / "lamp_1.off").unlink()
    with pytest.raises(ValueError, match=r"lamp/test: 0 objects"):
        opened(tmp_path)


@pytest.mark.parametrize(("count", "held"), [(2, 1), (5, 1), (10, 2), (13, 3)])
def test_folders_without_splits_hold_out_the_last(tmp_path, count, held):
    (tmp_path / "cup").mkdir()
    for i in range(count):
        np.save(tmp_path / "cup" / f"{i:02d}.npy", np.eye(3) * (i + 1))
    dataset = opened(tmp_path)
    assert [item.name for item in dataset.objects] == [f"cup/{i:02d}.npy" for i in range(count)]
    assert [item.split for item in dataset.objects] == ["train"] * (count - held) + ["test"] * held


@pytest.mark.parametrize("count", [0, 1])
def test_a_category_with_one_object_is_an_error(tmp_path, count):
    (tmp_path / "cup").mkdir()
    for i in range(count):
        np.save(tmp_path / "cup" / f"{i}.npy", np.eye(3))
    with pytest.raises(ValueError, match=rf"cup: a category with {count} object\(s\); expected at least 2"):
        opened(tmp_path)


def test_every_format_is_read_and_what_is_passed_over_is_named(tmp_path):
    (tmp_path / "cup").mkdir()
    np.save(tmp_path / "cup" / "0.npy", np.eye(3))
    for i, name in enumerate(("1.pcd", "2.xyz", "3.ply.gz")):
        write_moved(tmp_path / "cup" / name, read_geometry(tmp_path / "cup" / "0.npy"), np.diag([i + 2, i + 2, i + 2, 1]))
    (tmp_path / "cup" / "notes.txt").write_text("not an object")
    objects = opened(tmp_path).objects
    assert [item.name for item in objects] == ["cup/0.npy", "cup/1.pcd", "cup/2.xyz", "cup/3.ply.gz"]
    for i, item in enumerate(objects):
        np.testing.assert_allclose(item.geometry(), np.eye(3) * (i + 1), atol=1e-7)
    for name in ("1.pcd", "2.xyz", "3.ply.gz"):
        (tmp_path / "cup" / name).rename(tmp_path / "cup" / f"{name}.bak")
    passed = r"\(passed over: 1\.pcd\.bak, 2\.xyz\.bak, 3\.ply\.gz\.bak, notes\.txt\)"
    with pytest.raises(ValueError, match=rf"cup: a category with 1 object\(s\) {passed}; expected at least 2 files of \.ply, \.pcd"):
        opened(tmp_path)
    (tmp_path / "cup" / "test").mkdir()
    (tmp_path / "cup" / "train").mkdir()
    for i in range(7):
        (tmp_path / "cup" / "train" / f"{i}.blend").write_text("")
    with pytest.raises(ValueError, match=r"train: 0 objects \(passed over: 0\.blend, .*4\.blend and 2 more\)"):
        opened(tmp_path)


def test_a_text_file_is_an_object_where_there_are_no_others(tmp_path):
    """As in the resampled ModelNet40 with normals: x, y, z, nx, ny, nz a line."""
    (tmp_path / "cup").mkdir()
    for i in range(2):
        (tmp_path / "cup" / f"cup_{i}.txt").write_text("1,0,0,0,0,1\n0,1,0,0,0,1\n0,0,1,0,0,1\n")
    for item in opened(tmp_path).objects:
        np.testing.assert_array_equal(item.geometry(), np.eye(3))
