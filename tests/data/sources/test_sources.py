"""The declarations of all sources, and the input that every source refuses."""

import dataclasses
import pickle

import numpy as np
import pytest

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.prepare import ensure_prepared
from cmig_jax.data.recordings import ensure_recordings
from cmig_jax.data.sources import SOURCES, open_objects, open_recordings, source_of


def test_a_source_is_found_by_its_name_and_names_flags_that_exist():
    flags = {field.name for field in dataclasses.fields(DataConfig)}
    for name, source in SOURCES.items():
        assert source_of(DataConfig(source=name)) is source
        assert set(source.flags) <= flags
        assert not (source.records and source.trains)
    with pytest.raises(ValueError, match=r"data\.source = nothing: expected one of shapes, modelnet40-hdf5, meshes, "):
        source_of(DataConfig(source="nothing"))


def test_shapes_are_a_function_of_split_label_and_index():
    few, many = (open_objects(DataConfig(source="shapes", shapes=shapes)).objects for shapes in (4, 9))
    assert [[sum(item.split == split for item in objects) for split in ("train", "test")] for objects in (few, many)] == [
        [160, 40],
        [360, 80],
    ]
    by_name = {item.name: pickle.loads(pickle.dumps(item)) for item in many}
    assert len(by_name) == len(many)
    for item in few[::17]:
        np.testing.assert_array_equal(item.geometry().vertices, by_name[item.name].geometry().vertices)
    train, test = (next(item for item in few if item.split == split) for split in ("train", "test"))
    assert not np.array_equal(train.geometry().bounds, test.geometry().bounds)


@pytest.mark.parametrize("source", [name for name, source in SOURCES.items() if source.folder])
def test_a_missing_or_empty_root_is_an_error(source, tmp_path):
    opener = open_recordings if SOURCES[source].records else open_objects
    for root, message in (
        (None, r"data\.root = None: expected"),
        (f"{tmp_path}/nowhere", "nowhere: no such folder; expected"),
        (str(tmp_path), rf"{tmp_path}.*: no .*expected"),
    ):
        with pytest.raises(ValueError, match=message):
            opener(DataConfig(source=source, root=root))


@pytest.mark.parametrize("source", SOURCES)
def test_objects_and_recordings_are_not_confused(source, tmp_path):
    data = DataConfig(source=source, root=str(tmp_path), prepared=str(tmp_path / "out"))
    if SOURCES[source].records:
        with pytest.raises(ValueError, match=rf"{source} has recorded pairs, no objects: it is for evaluation only .*evaluate\.py"):
            ensure_prepared(data, ViewsConfig(of="both"))
    else:
        with pytest.raises(ValueError, match=rf"{source} has objects, no recordings: expected stanford-scans or sevenscenes-fragments"):
            ensure_recordings(data)
    assert list(tmp_path.iterdir()) == []
