"""ModelNet40 as HDF5: every row of every file, in its order; errors name the file, the value and what was expected."""

import json
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest

from cmig_jax.config import DataConfig
from cmig_jax.data.sources import open_objects

RNG = np.random.default_rng(0)


def opened(root: Path):
    return open_objects(DataConfig(source="modelnet40-hdf5", root=str(root)))


def write(folder: Path, name: str, count: int, *, dtype=np.float32, **datasets) -> None:
    data = np.clip(RNG.normal(size=(count, 32, 3)) * 0.2, -0.5, 0.5).astype(dtype)
    with h5py.File(folder / name, "w") as file:
        for key, value in ({"data": data, "label": np.arange(count, dtype=np.uint8)[:, None] % 2} | datasets).items():
            if value is not None:
                file[key] = value


@pytest.fixture
def root(tmp_path) -> Path:
    (tmp_path / "shape_names.txt").write_text("cup\nchair\n")
    write(tmp_path, "ply_data_train0.h5", 5)
    write(tmp_path, "ply_data_train1.h5", 3, dtype=np.float16)
    write(tmp_path, "ply_data_test0.h5", 2)
    return tmp_path


def test_every_row_of_every_file_is_an_object(root):
    (root / "ply_data_train_0_id2file.json").write_text(json.dumps([f"cup/cup_{i}.ply" for i in range(5)]))
    (root / "ply_data_test_0_id2name.txt").write_text("pack\ta.obj\npack\tb.obj\n")
    dataset = opened(root)
    assert dataset.categories == ("cup", "chair")
    assert [item.split for item in dataset.objects] == ["train"] * 8 + ["test"] * 2
    assert [item.label for item in dataset.objects] == [0, 1, 0, 1, 0, 0, 1, 0, 0, 1]
    names = [item.name for item in dataset.objects]
    assert names[4:6] == ["cup/cup_4.ply", "ply_data_train1.h5[0]"]
    assert names[8:] == ["pack/a.obj", "pack/b.obj"]
    with h5py.File(root / "ply_data_train1.h5") as file:
        expected = file["data"][1].astype(np.float32)
    for item in (dataset.objects[6], pickle.loads(pickle.dumps(dataset.objects[6]))):
        np.testing.assert_array_equal(item.geometry(), expected)
        assert item.geometry().dtype == np.float64
    assert all(item.shuffled for item in dataset.objects)


@pytest.mark.parametrize(
    ("datasets", "message"),
    [
        ({"data": None}, r"holds \['label'\]; expected a dataset `data`"),
        ({"label": None}, r"holds \['data'\]; expected a dataset `label`"),
        ({"data": np.zeros((5, 96))}, r"data of shape \(5, 96\); expected \[n, points, 3\]"),
        ({"data": np.zeros((5, 32, 2))}, r"data of shape \(5, 32, 2\)"),
        ({"label": np.zeros((4, 1), int)}, r"label of shape \(4, 1\).*expected 5"),
        ({"label": np.zeros((5, 1), np.float32)}, "label of shape .*float32; expected 5 whole numbers"),
        ({"label": np.full((5, 1), 2)}, "label 2; expected 0 to 1"),
        ({"label": np.full((5, 1), -1)}, "label -1; expected 0 to 1"),
    ],
)
def test_a_wrong_file_is_an_error(root, datasets, message):
    write(root, "ply_data_train0.h5", 5, **datasets)
    with pytest.raises(ValueError, match=rf"ply_data_train0\.h5: {message}"):
        opened(root)


def test_a_damaged_folder_is_an_error(root):
    bad = np.zeros((2, 32, 3), np.float32)
    bad[1, 4] = np.nan
    write(root, "ply_data_test0.h5", 2, data=bad)
    with pytest.raises(ValueError, match=r"ply_data_test0\.h5\[1\]: point 4 is"):
        opened(root).objects[-1].geometry()
    (root / "ply_data_test_0_id2name.txt").write_text("one\n")
    with pytest.raises(ValueError, match=r"id2name\.txt: 1 names; expected 2"):
        opened(root)
    (root / "ply_data_test_0_id2name.txt").unlink()
    (root / "ply_data_test_0_id2file.json").write_text('["one"')
    with pytest.raises(ValueError, match=r"id2file\.json: expected a JSON list of names"):
        opened(root)
    train = root / "ply_data_train0.h5"
    train.write_bytes(train.read_bytes()[:500])
    with pytest.raises(ValueError, match=r"ply_data_train0\.h5: not a readable HDF5 file"):
        opened(root)
    (root / "shape_names.txt").unlink()
    with pytest.raises(ValueError, match=r"shape_names\.txt: no such file"):
        opened(root)


def test_real_objects(real_data):
    dataset = opened(real_data("objects_hdf5_2048"))
    assert len(dataset.categories) == 40
    assert [sum(item.split == split for item in dataset.objects) for split in ("train", "test")] == [2352, 587]
    assert {item.label for item in dataset.objects} == set(range(40))
    assert len({item.name for item in dataset.objects}) == 2939
    points = dataset.objects[100].geometry()
    assert points.shape == (2048, 3)
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(1, abs=2e-3)
