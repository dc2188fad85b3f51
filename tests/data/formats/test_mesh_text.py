"""OFF and OBJ, with faces or with points alone."""

import numpy as np
import pytest
import trimesh

BOX = trimesh.creation.box((1, 2, 3))
CLOUD = [[0, 0, 0], [1, 0, 0], [0, 2.5, 0]]
OBJ = "mtllib a.mtl\no box\nv 0 0 0 0.5 0.5 1\nv 1 0 0 0.5 0.5 1\nv 0 2.5 0 0.5 0.5 1\nvn 0 0 1\nvt 0 0\nusemtl red\nf 1/1/1 2/1/1 3/1/1\n"


def off(header: str = "OFF\n") -> str:
    lines = [f"{header}{len(BOX.vertices)} {len(BOX.faces)} 0", *(f"{x} {y} {z}" for x, y, z in BOX.vertices)]
    return "\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in BOX.faces)]) + "\n"


def faces_of(mesh) -> list:
    return sorted(sorted(face) for face in mesh.faces.tolist())


@pytest.mark.parametrize(
    "text",
    [
        off(),
        off("OFF"),
        off("OFF "),
        off("\n\n \t OFF"),
        off("# made by hand\nOFF # header\n\n"),
        off().replace("\n", "\r\n"),
        off().replace("\n", "\r"),
        off().replace(" 0\n", " # no edges\n", 1),
        off().replace(" 0\n", " 0 # counts\n# vertices\n\n", 1),
        off("COFF\n").replace("0.5 1.0 1.5\n", "0.5 1.0 1.5 255 0 0 255\n"),
        "\n".join(line + (" 255 0 0" if line.startswith("3 ") else "") for line in off().split("\n")),
    ],
)
def test_off_files_of_one_box(read, text):
    found = read("a.off", text)
    np.testing.assert_array_equal(found.points, BOX.vertices)
    np.testing.assert_array_equal(found.mesh.faces, BOX.faces)


def test_faces_of_more_corners(read):
    text = "OFF 5 3 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n0 2 0\n4 0 1 2 3\n3 2 4 3\n2 0 1\n"
    assert read("a.off", text).mesh.area == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.off", "OFF\n3 0 0\n0 0 0\n1 0 0\n0 2.5 0\n"),
        ("a.off", "\r\nNOFF\r\n3 0\r\n0 0 0 0 0 1\r\n1 0 0 0 0 1\r\n0 2.5 0 0 0 1\r\n"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 2.5 0\n"),
        ("a.obj", "# points\r\nv 0 0 0 0.5 0.5 1\r\nv 1 0 0 0.5 0.5 1\r\n\r\nv 0 2.5 0 0.5 0.5 1\r\n"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 2.5 0\np 1 2 3\nl 1 2\n"),
    ],
)
def test_points_alone_are_a_cloud(read, name, text):
    found = read(name, text)
    assert found.mesh is None
    np.testing.assert_array_equal(found.points, CLOUD)


def test_a_moved_obj_keeps_its_materials_and_faces(read, move, matrix):
    source = read("a.obj", OBJ)
    path, found = move(source, "b.obj", matrix)
    np.testing.assert_allclose(found.points, source.points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-8)
    assert faces_of(found.mesh) == faces_of(source.mesh)
    lines = path.read_text().split("\n")
    assert [line for line in lines if not line.startswith(("v ", "vn"))] == [
        "mtllib a.mtl",
        "o box",
        "vt 0 0",
        "usemtl red",
        "f 1/1/1 2/1/1 3/1/1",
        "",
    ]
    assert all(line.endswith(" 0.5 0.5 1") for line in lines if line.startswith("v "))
    (normal,) = (line.split()[1:] for line in lines if line.startswith("vn"))
    np.testing.assert_allclose(np.array(normal, float), matrix[:3, 2], atol=1e-5)


def test_a_moved_off_keeps_colours_and_turns_normals(read, move, matrix, to_utm):
    text = "CNOFF\n3 1 0\n0 0 0 0 0 1 255 0 7 9\n1 0 0 0 0 1 255 0 7 9\n0 2.5 0 0 0 1 255 0 7 9\n3 0 1 2 0.5 0.5 0.5\n"
    path, found = move(read("a.off", text), "b.off", to_utm)
    np.testing.assert_allclose(found.points, np.array(CLOUD) @ to_utm[:3, :3].T + to_utm[:3, 3], rtol=0, atol=1e-8)
    lines = path.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("CNOFF", "3 0 1 2 0.5 0.5 0.5")
    for line in lines[2:5]:
        np.testing.assert_allclose(np.array(line.split()[3:], float), [*matrix[:3, 2], 255, 0, 7, 9], atol=1e-5)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.off", "hello there\n1 2 3\n", "expected a first line OFF"),
        ("a.off", "OFF BINARY\n1 2 3\n", "expected a first line OFF"),
        ("a.off", "OFF\n", "counts ''; expected the numbers of vertices and faces"),
        ("a.off", off()[:-40], "expected 8 vertices and 12 faces"),
        ("a.off", off().rstrip()[:-3], "the last face has"),
        ("a.off", "OFF 2147483648 0 0\n0 0 0\n", "1 lines of data; expected 2147483648 vertices"),
        ("a.off", "OFF 3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n", "a face of vertex 9; expected 0 to 2"),
        ("a.off", "OFF 2 0 0\n0 0 0\n1 0\n", "vertex 1 has 2 coordinates; expected 3"),
        ("a.off", "OFF 2 0 0\n0 0 0\n1 0 one\n", "could not convert"),
        ("a.off", "OFF 0 0 0\n", "0 points; expected at least 1"),
        ("a.obj", "# nothing\n", "0 points; expected at least 1"),
        ("a.obj", "v 0 0\n", "vertex 0 has 2 coordinates; expected 3"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", r"a\.obj: "),
        ("a.obj", b"glTF\0\0\0\0", "binary data.*it begins like a file of .glb"),
    ],
)
def test_damage_is_named(read, tmp_path, name, content, message):
    with pytest.raises(ValueError, match=message) as raised:
        read(name, content)
    assert str(raised.value).startswith(str(tmp_path / name))
