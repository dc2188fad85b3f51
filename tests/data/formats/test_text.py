"""Points as text: the layout is found out, and stays after a move."""

import numpy as np
import pytest

POINTS = [[1.5, 2.5, -3.0], [4.0, 5.0, 6.25], [-7.0, 8.0, 9e-3]]


def table(separator: str, *, order=(0, 1, 2), before=(), behind=(), line_end="\n") -> str:
    return line_end.join(separator.join([*before, *(repr(row[i]) for i in order), *behind]) for row in POINTS) + line_end


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.xyz", table(" ")),
        ("a.xyz", table("   ", behind=["255", "0", "7"])),
        ("a.txt", table("\t", line_end="\r\n")),
        ("a.txt", table("\t", line_end="\r")),
        ("a.csv", table(",")),
        ("a.csv", "\ufeffx,y,z\n" + table(",")),
        ("a.csv", "time;Y;X;Z;name\n" + table(";", order=(1, 0, 2), before=["0.5"], behind=["a tree"])),
        ("a.csv", '"X (m)","Y (m)","Z (m)","class"\n' + table(",", behind=['"tree, tall"'])),
        ("a.csv", "Points:0,Points:1,Points:2\n" + table(",")),
        ("a.csv", "x;y;z\n1,5;2,5;-3\n4,0;5,0;6,25\n-7;8;0,009\n"),
        ("a.csv", "a,b,c\n" + table(",")),
        ("a.asc", "//X Y Z R G B\n" + table(" ", behind=["1", "2", "3"])),
        ("a.asc", "# x y z\n3\n\n" + table(" ")),
        ("a.pts", "3\n" + table(" ", behind=["130", "216", "162", "130"])),
        ("a.pts", "\n3 \r\n" + table(" ", line_end="\r\n")),
        ("a.txt", "# a remark\n" + table(", ") + "# the end\n"),
        ("a.txt", ("\ufeff" + table(" ")).encode("utf-16-le")),
        ("a.txt", "# Höhe\n".encode("latin-1") + table(" ").encode()),
        ("a.txt", table(" ")[:-1]),
    ],
)
def test_layouts(read, name, content):
    np.testing.assert_array_equal(read(name, content).points, POINTS)


def test_empty_cells_are_not_finite(read):
    content = "x,y,z,i\n1,2,3,9\n,,,9\nnan,NaN,null,9\n4,5,6,9\n"
    with pytest.raises(ValueError, match="2 of 4 points"):
        read("a.csv", content)
    found = read("a.csv", content, "drop")
    assert found.dropped == 2
    np.testing.assert_array_equal(found.points, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x,y,z\n", "no points"),
        ("600\n", "no points"),
        ("# only a remark\n", "no points"),
        ("\n\n", "no points"),
        ("4\n" + table(" "), "3 lines of points; expected 4"),
        ("2147483648\n" + table(" "), "expected 2147483648"),
        ("1 2\n3 4\n", r"a line of 2 column\(s\), '1 2'; expected at least x, y and z"),
        ("name,a,b,c\ntree,1,2,3\n", "line 2 is 'tree,1,2,3'; expected numbers in the first three columns"),
        ("x,y,z\n1,2,3\n1,two,3\n", "line 3 is '1,two,3'; expected numbers in x, y and z"),
        ("1 2 3\n4 5\n", "line 2 is '4 5'; expected numbers in the first three columns"),
        ("the first\nof two lines\n", "expected numbers in the first three columns"),
        (b"1 2 3\0\n", "binary data; expected text"),
        (b"\x93NUMPY\x01\0", "binary data; expected text.*it begins like a file of .npy"),
    ],
)
@pytest.mark.parametrize("suffix", ["xyz", "csv", "pts"])
def test_damage_is_named(read, suffix, content, message):
    with pytest.raises(ValueError, match=message) as raised:
        read(f"a.{suffix}", content)
    assert f"a.{suffix}: not a readable {suffix.upper()} file" in str(raised.value)


def test_a_move_keeps_header_columns_and_remarks(read, move, matrix):
    content = "# made by hand\r\ntime;X;Y;Z;name\r\n" + table(";", before=["0,5"], behind=["a tree"], line_end="\r\n") + "# the end\r\n"
    path, found = move(read("a.csv", content), "b.csv", matrix)
    np.testing.assert_allclose(found.points, np.array(POINTS) @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-7)
    lines = path.read_bytes().decode().split("\r\n")
    assert (lines[:2], lines[-2:]) == (["# made by hand", "time;X;Y;Z;name"], ["# the end", ""])
    assert [line.split(";")[::4] for line in lines[2:5]] == [["0,5", "a tree"]] * 3


def test_normals_are_turned_and_colours_are_not(read, move, cloud, matrix):
    for columns, expected in ((cloud.normals, cloud.normals @ matrix[:3, :3].T), (cloud.colours, cloud.colours)):
        content = "\n".join(" ".join(map(str, row)) for row in np.c_[cloud.points, columns].tolist())
        path, found = move(read("a.xyz", content), "b.xyz", matrix)
        np.testing.assert_allclose(np.loadtxt(path)[:, 3:], expected, atol=1e-5)
        np.testing.assert_allclose(found.points, cloud.points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-8)
    content = "nz,ny,nx,x,y,z\n" + "\n".join(",".join(map(str, row)) for row in np.c_[cloud.normals[:, ::-1], cloud.points].tolist())
    path, _ = move(read("a.csv", content), "b.csv", matrix)
    np.testing.assert_allclose(np.loadtxt(path, delimiter=",", skiprows=1)[:, 2::-1], cloud.normals @ matrix[:3, :3].T, atol=1e-5)


def test_decimal_commas_stay(read, move):
    path, _ = move(read("a.csv", "x;y;z\n1,5;2,5;-3,5\n4,5;5,5;6,5\n"), "b.csv", np.eye(4))
    lines = path.read_text().splitlines()
    assert "." not in "".join(lines)
    assert float(lines[1].split(";")[0].replace(",", ".")) == 1.5


def test_utm_coordinates_keep_a_millionth_of_the_extent(read, move, cloud, to_utm):
    source = read("a.xyz", "\n".join(" ".join(map(str, row)) for row in cloud.points.tolist()))
    _, found = move(source, "b.xyz", to_utm)
    np.testing.assert_allclose(found.points, source.points @ to_utm[:3, :3].T + to_utm[:3, 3], rtol=0, atol=1e-8)


@pytest.mark.parametrize(("name", "first"), [("b.pts", "3"), ("b.csv", "x,y,z,i"), ("b.xyz", None)])
def test_another_suffix_gets_its_usual_head(read, move, name, first):
    path, found = move(read("a.txt", "#x y z i\n" + table(" ", behind=["7"])), name, np.eye(4))
    np.testing.assert_allclose(found.points, POINTS, atol=1e-8)
    lines = path.read_text().splitlines()
    assert len(lines) == 3 + (first is not None)
    assert first is None or lines[0] == first
    assert lines[-1].replace(",", " ").split()[3] == "7"
