"""PLY in all its kinds, and its attributes after a move."""

import numpy as np
import pytest
import trimesh

BOX = trimesh.creation.box((1, 2, 3))
HEADER = "ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
ROWS = "0 0 0\n1 0 0\n0 2 0\n"
CORNERS = [[0, 0, 0], [1, 0, 0], [0, 2, 0]]
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
VERTEX = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("nx", "f4"), ("ny", "f4"), ("nz", "f4"), ("red", "u1"), ("intensity", "f4")]
NAMES = {"f8": "double", "f4": "float", "u1": "uchar", "i4": "int"}


def with_attributes(cloud, points, order="<", faces=((0, 1, 2), (1, 2, 3, 4))) -> bytes:
    """A binary PLY with normals, a colour, an intensity, faces of three and four corners, and a grid of empty and single lists."""
    rows = np.zeros(len(points), [(name, order + kind) for name, kind in VERTEX])
    for i, name in enumerate("xyz"):
        rows[name], rows[f"n{name}"] = points[:, i], cloud.normals[:, i]
    rows["red"], rows["intensity"] = cloud.colours[:, 0], cloud.points[:, 0] * 7
    header = [
        "ply",
        f"format binary_{'little' if order == '<' else 'big'}_endian 1.0",
        "obj_info num_cols 2",
        f"element vertex {len(rows)}",
    ]
    header += [f"property {NAMES[kind]} {name}" for name, kind in VERTEX]
    header += [f"element face {len(faces)}", "property list uchar int vertex_index", "property uchar flags"]
    header += ["element range_grid 2", "property list uchar int vertex_indices", "end_header", ""]
    body = b"".join(bytes([len(face)]) + np.array(face, order + "i4").tobytes() + b"\x07" for face in faces)
    grid = b"\x00" + b"\x01" + np.array([5], order + "i4").tobytes()
    return "\n".join(header).encode() + rows.tobytes() + body + grid


@pytest.mark.parametrize(
    "text",
    [
        HEADER + "end_header\n" + ROWS,
        "\n \n" + HEADER + "end_header\n" + ROWS,
        (HEADER + "end_header\n" + ROWS).replace("\n", "\r\n"),
        (HEADER + "end_header\n" + ROWS).replace("\n", "\r"),
        HEADER.replace("float x", "float X").replace("float y", "float Y").replace("float z", "float64 Z") + "end_header\n" + ROWS,
        HEADER + "element edge 1\nproperty int vertex1\nproperty int vertex2\nend_header\n" + ROWS + "0 1\n",
        HEADER + FACE.replace("1", "0") + "end_header\n" + ROWS,
        HEADER + "property uchar red\nproperty list uchar float weights\nend_header\n0 0 0 9 1 0.5\n1 0 0 8 0\n0 2 0 7 2 1 2\n",
    ],
)
def test_clouds_as_text(read, text):
    found = read("a.ply", text)
    assert found.mesh is None
    np.testing.assert_array_equal(found.points, CORNERS)


@pytest.mark.parametrize("line_end", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_binary_data_may_begin_with_any_byte(read, order, line_end):
    points = np.frombuffer(b"\n\r\x0a\x41" * 6, order + "f4").reshape(-1, 3)
    name = {"<": "little", ">": "big"}[order]
    header = HEADER.replace("ascii", f"binary_{name}_endian").replace("vertex 3", "vertex 2") + "end_header\n"
    found = read("a.ply", header.encode().replace(b"\n", line_end) + points.tobytes())
    np.testing.assert_array_equal(found.points, points.astype(np.float64))


@pytest.mark.parametrize("order", ["<", ">"])
def test_faces_of_different_lengths(read, cloud, order):
    found = read("a.ply", with_attributes(cloud, cloud.points, order))
    assert found.mesh is not None
    assert sorted(map(sorted, found.mesh.faces.tolist())) == [[0, 1, 2], [1, 2, 3], [1, 3, 4]]
    np.testing.assert_array_equal(found.points, cloud.points)


def test_text_and_binary_of_trimesh(read):
    for encoding in ("ascii", "binary"):
        mesh = read("a.ply", BOX.export(file_type="ply", encoding=encoding)).mesh
        np.testing.assert_array_equal(mesh.faces, BOX.faces)
        assert mesh.volume == pytest.approx(6)


def test_strips_of_triangles(read):
    strips = "element tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    found = read("a.ply", HEADER.replace("vertex 3", "vertex 5") + strips + ROWS + "1 1 1\n5 5 5\n7 0 1 2 -1 1 2 3\n")
    assert found.mesh.area == pytest.approx(1 + 0.5 * np.linalg.norm(np.cross([-1, 2, 0], [0, 1, 1])))


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_move_keeps_every_attribute(read, move, cloud, matrix, order):
    source = read("a.ply", with_attributes(cloud, cloud.points, order))
    path, found = move(source, "b.ply", matrix)
    np.testing.assert_allclose(found.points, cloud.points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-14)
    np.testing.assert_array_equal(found.mesh.faces, source.mesh.faces)
    vertex, face, grid = (columns for _, columns in found.content.elements)
    np.testing.assert_allclose(np.stack([vertex[f"n{name}"] for name in "xyz"], -1), cloud.normals @ matrix[:3, :3].T, atol=1e-6)
    np.testing.assert_array_equal(vertex["red"], cloud.colours[:, 0])
    np.testing.assert_array_equal(vertex["intensity"], (cloud.points[:, 0] * 7).astype(np.float32))
    assert [row.tolist() for row in face["vertex_index"]] == [[0, 1, 2], [1, 2, 3, 4]]
    assert face["flags"].tolist() == [7, 7]
    assert [row.tolist() for row in grid["vertex_indices"]] == [[], [5]]
    assert b"obj_info num_cols 2" in path.read_bytes()


def test_utm_coordinates_stay_exact(read, move, cloud, to_utm):
    """In single precision, y near 5e6 is a multiple of 0.5."""
    source = read("a.ply", trimesh.PointCloud(cloud.points).export(file_type="ply"))
    expected = source.points @ to_utm[:3, :3].T + to_utm[:3, 3]
    path, found = move(source, "b.ply", to_utm)
    np.testing.assert_allclose(found.points, expected, rtol=0, atol=1e-8)
    np.testing.assert_allclose(trimesh.load(path).vertices, expected, rtol=0, atol=1e-8, err_msg="another reader")
    assert b"property double x" in path.read_bytes()
    path, _ = move(source, "c.ply", np.eye(4))
    assert b"property float x" in path.read_bytes(), "single precision where it suffices"


def test_rows_that_are_not_finite(read, move, matrix):
    text = HEADER.replace("vertex 3", "vertex 5") + "end_header\n" + ROWS + "nan nan nan\ninf 0 0\n"
    with pytest.raises(ValueError, match=r"point 3 is \[nan, nan, nan\].*2 of 5 points.*--drop-invalid"):
        read("a.ply", text)
    source = read("a.ply", text, "drop")
    assert (source.dropped, len(source.points)) == (2, 3)
    _, found = move(source, "b.ply", matrix, "drop")
    assert found.dropped == 2, "rows keep their place"
    np.testing.assert_allclose(found.points, np.array(CORNERS) @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-6)


def test_a_mesh_loses_the_faces_at_dropped_vertices(read):
    text = HEADER.replace("vertex 3", "vertex 4") + FACE.replace("1", "2") + "end_header\nnan 0 0\n" + ROWS + "3 0 1 2\n3 1 2 3\n"
    found = read("a.ply", text, "drop")
    assert found.dropped == 1
    np.testing.assert_array_equal(found.mesh.faces, [[0, 1, 2]])
    np.testing.assert_array_equal(found.points, CORNERS)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEADER, "no end_header"),
        (HEADER + "end_header\n", r"data for 0 rows of the element 'vertex'; expected 3 rows"),
        (HEADER + "end_header\n" + ROWS[:-4], "data for 2 rows"),
        (HEADER + "end_header\n" + ROWS + "7\n", "1 numbers too many"),
        (HEADER + "end_header\n" + ROWS.replace("2", "two"), "a word among the data"),
        (HEADER.replace("float y", "float w") + "end_header\n" + ROWS, r"expected an element vertex with x, y and z"),
        (HEADER.replace("ascii", "binary") + "end_header\n" + ROWS, "no line `format`"),
        (HEADER.replace("vertex 3", "vertex -3") + "end_header\n" + ROWS, "expected element NAME COUNT"),
        (HEADER.replace("vertex 3", "vertex 2147483648") + "end_header\n" + ROWS, "2147483648 rows"),
        (
            HEADER.replace("vertex 3", "vertex 2147483648").replace("ascii", "binary_little_endian") + "end_header\n" + ROWS,
            "2147483648 rows",
        ),
        (HEADER + FACE.replace("1", "2147483648") + "end_header\n" + ROWS + "3 0 1 2\n", "2147483648 rows"),
        (HEADER + FACE + "end_header\n" + ROWS + "3 0 1\n", "face 0 of 1 cannot be read"),
        (HEADER + FACE + "end_header\n" + ROWS + "3 0 1 9\n", "a face of vertex 9; expected 0 to 2"),
        (HEADER.replace("float x", "float") + "end_header\n" + ROWS, "expected property TYPE NAME"),
        (HEADER.replace("vertex 3", "vertex 0") + "end_header\n", "0 points; expected at least 1"),
        ("solid box\n", "expected a first line `ply`"),
        ("# .PCD v0.7\n", "it begins like a file of .pcd"),
    ],
)
def test_damage_is_named(read, tmp_path, content, message):
    with pytest.raises(ValueError, match=message) as raised:
        read("a.ply", content)
    assert str(raised.value).startswith(str(tmp_path / "a.ply"))


@pytest.mark.parametrize("cut", [1, 5, 20, 60, 700])
def test_binary_data_cut_short(read, cloud, cut):
    with pytest.raises(ValueError, match="not a readable PLY file"):
        read("a.ply", with_attributes(cloud, cloud.points)[:-cut])
    with pytest.raises(ValueError, match="9 bytes behind the last element"):
        read("a.ply", with_attributes(cloud, cloud.points) + b"123456789")
