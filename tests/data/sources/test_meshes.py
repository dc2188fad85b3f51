"""A folder of meshes or clouds by category."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cmig_jax.config import DataConfig
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
