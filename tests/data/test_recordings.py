"""Recordings on disk: which of them are pairs, continuation, damage, and the transform between two."""

import os
from dataclasses import replace

import numpy as np
import pytest

from cmig_jax.config import DataConfig
from cmig_jax.data.recordings import MANIFEST, OVERLAP, between, ensure_recordings, read_manifest, read_recording


@pytest.fixture
def data(tmp_path, scans) -> DataConfig:
    return DataConfig(source="stanford-scans", root=str(scans.write(tmp_path / "scans")), prepared=str(tmp_path / "out"))


def pairs_of(data: DataConfig) -> list:
    return read_manifest(ensure_recordings(data, progress=False))["pairs"]


def test_pairs_overlap_in_either_order(data):
    pairs = pairs_of(data)
    assert [(i, j) for i, j, _ in pairs] == [(0, 1), (1, 0), (1, 2), (2, 1)]
    shares = [share for _, _, share in pairs]
    assert shares == pytest.approx([2 / 3, 2 / 3, 1 / 2, 1 / 2], abs=0.1)
    assert min(shares) >= OVERLAP


def test_the_overlap_does_not_depend_on_the_unit(tmp_path, data, scans):
    large = replace(data, root=str(scans.write(tmp_path / "large", unit=1000.0)), prepared=str(tmp_path / "large-out"))
    np.testing.assert_allclose(pairs_of(large), pairs_of(data), atol=1e-3)


def test_without_a_name_the_folder_is_named_after_source_and_root(tmp_path, data, scans, monkeypatch):
    monkeypatch.chdir(tmp_path)
    data = replace(data, prepared=None)
    other = replace(data, root=str(scans.write(tmp_path / "other")))
    folders = [ensure_recordings(one, progress=False) for one in (data, other, replace(data, points=5), replace(data, root="scans"))]
    assert [str(folder).startswith(f"data{os.sep}stanford-scans-") for folder in folders] == [True] * 4
    assert folders[0] == folders[2] == folders[3] != folders[1]


def test_a_preparation_continues_where_it_stopped_and_removes_temporary_files(data, tmp_path):
    missing, out = tmp_path / "scans" / "toy2.ply", tmp_path / "out"
    content = missing.read_bytes()
    missing.write_bytes(content[:300])
    with pytest.raises(ValueError, match=r"toy2\.ply: not a readable PLY"):
        pairs_of(data)
    made = {path: path.stat().st_mtime_ns for path in out.glob("*.npy")}
    assert len(made) == 2
    missing.write_bytes(content)
    (out / ".toy-toy2.123.partial.npy").write_bytes(b"of a process that was killed")
    assert len(pairs_of(data)) == 4
    assert {path: path.stat().st_mtime_ns for path in made} == made
    assert sorted(path.suffix for path in out.iterdir() if path.name != ".lock") == [".json", ".npy", ".npy", ".npy", ".npy"]


def test_a_damaged_folder_or_one_of_another_source_is_an_error(data, tmp_path):
    pairs_of(data)
    cloud = next((tmp_path / "out").glob("toy-toy0-*.npy"))
    cloud.write_bytes(cloud.read_bytes()[:500])
    with pytest.raises(ValueError, match=rf"{cloud.name}: not readable .* delete it"):
        read_recording(tmp_path / "out", cloud.name)
    with pytest.raises(ValueError, match=r"data\.source = sevenscenes-fragments, but .* was prepared with data\.source = stanford-scans"):
        ensure_recordings(replace(data, source="sevenscenes-fragments"))
    for text, message in (
        ("{}", "expected a manifest of format 1"),
        ('{"format": 1}', "expected a manifest of format 1"),
        ("{", "not readable"),
    ):
        (tmp_path / "out" / MANIFEST).write_text(text)
        with pytest.raises(ValueError, match=rf"pairs\.json: {message}"):
            pairs_of(data)


def test_scans_that_do_not_overlap_are_an_error(data, tmp_path):
    conf = tmp_path / "scans" / "toy.conf"
    lines = conf.read_text().splitlines()
    conf.write_text("\n".join([lines[1], lines[4]]))
    with pytest.raises(ValueError, match=r"none of 1 candidate pairs of 2 recordings overlaps by 0\.3"):
        pairs_of(data)


def test_a_transform_between_is_rigid(scans):
    poses = np.stack([np.eye(4)] * 2)
    for pose, rotation, shift in zip(poses, scans.poses[1:3], scans.shifts[1:3], strict=True):
        pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), shift
    point = np.array([0.3, -0.2, 0.9, 1.0])
    np.testing.assert_allclose(poses[1] @ between(*poses) @ point, poses[0] @ point, atol=1e-12)
    poses[0, :3, :3] += 1e-4
    R = between(*poses)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    for bad in (np.diag([2.0, 1, 1, 1]), np.diag([-1.0, 1, 1, 1])):
        with pytest.raises(ValueError, match=r"a to b: .*expected a rotation and a translation"):
            between(bad, np.eye(4), "a to b")
