"""Any file in, any file out: what all formats share. `formats/` has the tests of each."""

import gzip
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from cmig_jax.data import geometry_files as module
from cmig_jax.data.geometry_files import SUFFIXES, geometry_files, read_geometry, read_object, write_moved

BOX = trimesh.creation.box((1, 2, 3))
CLOUDS = (".ply", ".pcd", ".xyz", ".txt", ".csv", ".asc", ".pts", ".las", ".laz", ".npy", ".npz", ".bin", ".pcd.bin", ".off", ".obj")
MESHES = (".ply", ".off", ".obj", ".stl", ".glb", ".3mf")


@pytest.fixture(scope="module")
def matrix() -> np.ndarray:
    """A quarter turn about z and a translation."""
    return np.array([[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1.0]])


@pytest.fixture
def cloud(tmp_path):
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.save(tmp_path / "cloud.npy", points)
    return read_geometry(tmp_path / "cloud.npy")


@pytest.fixture
def box(tmp_path):
    BOX.export(tmp_path / "box.off")
    return read_geometry(tmp_path / "box.off")


@pytest.mark.parametrize("gz", ["", ".gz", ".GZ"])
@pytest.mark.parametrize("suffix", CLOUDS)
def test_a_cloud_in_every_format(tmp_path, cloud, matrix, suffix, gz):
    path = tmp_path / f"a{suffix.upper()}{gz}"
    write_moved(path, cloud, matrix)
    found = read_geometry(path)
    assert (found.mesh, found.dropped, found.points.dtype) == (None, 0, np.float64)
    np.testing.assert_allclose(found.points, cloud.points @ matrix[:3, :3].T + matrix[:3, 3], atol=4e-6)
    np.testing.assert_array_equal(read_object(path), found.points)
    assert (path.read_bytes()[:2] == b"\x1f\x8b") == bool(gz)


@pytest.mark.parametrize("suffix", MESHES)
def test_a_mesh_in_every_format(tmp_path, box, matrix, suffix):
    path = tmp_path / f"a{suffix}"
    write_moved(path, box, matrix)
    mesh = read_object(path)
    assert mesh.area == pytest.approx(22, rel=1e-5)
    assert mesh.volume == pytest.approx(6, rel=1e-5)
    np.testing.assert_allclose(mesh.bounds, [[9, 19.5, 28.5], [11, 20.5, 31.5]], atol=1e-5)


@pytest.mark.parametrize("suffix", sorted(set(CLOUDS) - set(MESHES)))
def test_of_a_mesh_a_format_of_clouds_holds_the_vertices(tmp_path, box, matrix, suffix):
    write_moved(tmp_path / f"a{suffix}", box, matrix)
    points = read_geometry(tmp_path / f"a{suffix}").points
    np.testing.assert_allclose(points, box.points @ matrix[:3, :3].T + matrix[:3, 3], atol=3e-6)


def test_every_suffix_is_tested():
    assert set(CLOUDS) | set(MESHES) == set(SUFFIXES)


@pytest.mark.parametrize("suffix", [".stl", ".glb", ".3mf"])
def test_formats_of_meshes_hold_no_cloud(tmp_path, cloud, matrix, suffix):
    with pytest.raises(ValueError, match=rf"a\{suffix}: .* holds meshes, and the source has no faces"):
        write_moved(tmp_path / f"a{suffix}", cloud, matrix)
    assert not (tmp_path / f"a{suffix}").exists()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_names_a_file_that_is_not_one(tmp_path, suffix):
    for content in (b"", b"\n", b"hello there\n", bytes(range(256)), b"\x00" * 7):
        path = tmp_path / f"a{suffix}"
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r".") as raised:
            read_geometry(path)
        assert str(raised.value).startswith(str(path)), content
        path.unlink()
        path.mkdir()
        with pytest.raises(ValueError, match="a folder; expected a file of"):
            read_geometry(path)
        path.rmdir()
        with pytest.raises(FileNotFoundError, match=f"a{suffix}"):
            read_geometry(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_survives_damage(tmp_path, cloud, box, matrix, suffix):
    """Of a damaged file the answer is an error that names it, or finite points; never another error, or a crash."""
    path, rng = tmp_path / f"a{suffix}", np.random.default_rng(0)
    write_moved(path, cloud if suffix in CLOUDS else box, matrix)
    content = path.read_bytes()
    for trial in range(60):
        damaged = bytearray(content)
        for _ in range(1 + trial % 3):
            damaged[rng.integers(len(damaged) if trial % 2 else min(300, len(damaged)))] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(damaged))] if trial % 4 == 0 else damaged)
        try:
            found = read_geometry(path)
        except ValueError as error:
            assert str(error).startswith(str(path))  # noqa: PT017
        else:
            assert np.isfinite(found.points).all()


def test_errors_of_compressed_and_unknown_files(tmp_path):
    for name, content, message in (
        ("a.ply.gz", gzip.compress(BOX.export(file_type="ply"))[:-20], "not a readable PLY file .damaged compression"),
        ("a.ply.gz", BOX.export(file_type="ply"), "damaged compression"),
        ("a.ply", gzip.compress(BOX.export(file_type="ply")), "it begins like a file of .gz"),
        ("a.gltf", b"{}", "expected a file of .ply, .pcd, .xyz"),
        ("a.gz", b"", "expected a file of .ply, .pcd, .xyz"),
        ("a", b"", "expected a file of .ply, .pcd, .xyz"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=message) as raised:
            read_geometry(tmp_path / name)
        assert str(raised.value).startswith(str(tmp_path / name))


def test_an_error_leaves_the_old_file(tmp_path, cloud, matrix, monkeypatch):
    (tmp_path / "a.ply").write_bytes(b"old")
    with pytest.raises(ValueError, match=r"a\.gltf: expected a file of"):
        write_moved(tmp_path / "a.gltf", cloud, matrix)
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("the disk is full")))
    with pytest.raises(OSError, match="the disk is full"):
        write_moved(tmp_path / "a.ply", cloud, matrix)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name != "cloud.npy"} == {"a.ply": b"old"}
    with pytest.raises(OSError, match="none"):
        write_moved(tmp_path / "none" / "a.ply", cloud, matrix)


def test_meshes_without_a_surface(tmp_path):
    for name, text, message in (
        ("flat.off", "OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n", "surface area 0"),
        ("nan.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n", "point 2 is"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=message):
            read_geometry(tmp_path / name)
    np.save(tmp_path / "a.npy", np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match="none of 2 points is finite"):
        read_geometry(tmp_path / "a.npy", "drop")


def test_parts_of_an_obj(tmp_path):
    first = "mtllib none.mtl\no one\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(first + "o two\nusemtl blue\nv 5 0 0\nv 6 0 0\nv 6 1 0\nv 5 1 0\nf 4/1 5/1 6/1 7/1\n")
    assert read_object(tmp_path / "a.obj").area == pytest.approx(1.5)


def test_text_beside_other_files_of_a_folder_is_no_geometry(tmp_path):
    (tmp_path / "notes.txt").write_text("made by hand")
    (tmp_path / ".hidden.ply").write_text("")
    assert [path.name for path in geometry_files(tmp_path)] == ["notes.txt"]
    for name in ("b.PCD", "a.ply.gz", "c.md"):
        (tmp_path / name).write_text("")
    assert [path.name for path in geometry_files(tmp_path)] == ["a.ply.gz", "b.PCD"]
    assert geometry_files(tmp_path / "none") == []


def test_libraries_of_single_formats_are_not_imported_at_start():
    script = f"import sys, {module.__name__}; print({{'laspy', 'lzf'}} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", script], text=True).strip() == "set()"
