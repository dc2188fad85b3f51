"""One geometry from one file: every format, and errors that start with the file's name."""

import io

import numpy as np
import pytest
import trimesh

from cmig_jax.data.geometry_files import read_geometry

BOX = trimesh.creation.box((1, 2, 3))


def off(header: str = "OFF\n") -> str:
    lines = [f"{header}{len(BOX.vertices)} {len(BOX.faces)} 0", *(f"{x} {y} {z}" for x, y, z in BOX.vertices)]
    return "\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in BOX.faces)]) + "\n"


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize("header", ["OFF\n", "OFF", "# made by hand\nOFF\n", "OFF\r\n"])
def test_off_headers(tmp_path, header):
    (tmp_path / "a.off").write_text(off(header))
    mesh = read_geometry(tmp_path / "a.off")
    assert mesh.area == pytest.approx(22)
    assert mesh.volume == pytest.approx(6)


@pytest.mark.parametrize("suffix", [".off", ".obj", ".ply", ".stl"])
def test_every_format_gives_the_same_surface(tmp_path, suffix):
    path = tmp_path / f"a{suffix.upper()}"
    BOX.export(str(path), file_type=suffix[1:])
    mesh = read_geometry(path)
    assert mesh.area == pytest.approx(22, rel=1e-5)
    assert mesh.volume == pytest.approx(6, rel=1e-5)


def test_parts_of_an_obj_and_ascii_stl(tmp_path):
    first = "mtllib none.mtl\no one\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(first + "o two\nusemtl blue\nv 5 0 0\nv 6 0 0\nv 6 1 0\nv 5 1 0\nf 4/1 5/1 6/1 7/1\n")
    assert read_geometry(tmp_path / "a.obj").area == pytest.approx(1.5)
    (tmp_path / "a.stl").write_text(BOX.export(file_type="stl_ascii"))
    assert read_geometry(tmp_path / "a.stl").area == pytest.approx(22)


def test_clouds(tmp_path):
    points = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    np.save(tmp_path / "a.npy", points.astype(np.float64))
    trimesh.PointCloud(points).export(tmp_path / "b.ply")
    for name in ("a.npy", "b.ply"):
        cloud = read_geometry(tmp_path / name)
        assert cloud.dtype == np.float64
        np.testing.assert_array_equal(cloud, points)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.off", b"", "not a readable OFF file"),
        ("words.off", b"hello there\n1 2 3\n", "expected a first line OFF"),
        ("short.off", off()[:-40].encode(), "expected 8 vertices and 12 faces"),
        ("cut.off", off().rstrip()[:-3].encode(), "the last face has"),
        ("none.off", b"OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "0 faces"),
        ("flat.off", b"OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n", "surface area 0"),
        ("nan.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n", "point 2 is"),
        ("index.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n", "range of its vertices|vertex 9"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "0 faces"),
        ("empty.obj", b"", "0 faces"),
        ("junk.ply", b"ply\nformat ascii 1.0\n", "no end_header"),
        ("cut.ply", BOX.export(file_type="ply")[:-20], "not a readable PLY file"),
        ("text.ply", BOX.export(file_type="ply", encoding="ascii")[:-60], "lines of data; expected 20"),
        ("cut.stl", BOX.export(file_type="stl")[:200], "not a readable STL file"),
        ("junk.npy", b"\x93NUMPY", "not a readable NPY file"),
        ("flat.npy", npy(np.zeros((5, 2))), r"flat\.npy: shape \(5, 2\), float64; expected \[N, 3\] real numbers"),
        ("mesh.gltf", b"{}", "expected a file of .off, .obj, .ply, .stl, .npy"),
    ],
)
def test_a_bad_file_is_an_error_that_names_it(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as raised:
        read_geometry(tmp_path / name)
    assert str(raised.value).startswith(str(tmp_path / name))
