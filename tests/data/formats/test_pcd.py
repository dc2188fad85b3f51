"""PCD in its encodings, organised or not, and its fields after a move."""

import struct

import lzf
import numpy as np
import pytest

FIELDS = [
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    ("_", "<u1", (4,)),
    ("normal_x", "<f4"),
    ("normal_y", "<f4"),
    ("normal_z", "<f4"),
    ("rgb", "<u4"),
]


def header(rows: np.ndarray, encoding: str, width: int, height: int = 1) -> bytes:
    kinds = [(name, rows.dtype[name]) for name in rows.dtype.names]
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", "FIELDS " + " ".join(name for name, _ in kinds)]
    lines += ["SIZE " + " ".join(str(kind.base.itemsize) for _, kind in kinds)]
    lines += ["TYPE " + " ".join(kind.base.kind.upper() for _, kind in kinds)]
    lines += ["COUNT " + " ".join(str(int(np.prod(kind.shape))) for _, kind in kinds)]
    lines += [f"WIDTH {width}", f"HEIGHT {height}", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {width * height}", f"DATA {encoding}", ""]
    return "\n".join(lines).encode()


@pytest.fixture
def rows(cloud):
    values = np.zeros(40, FIELDS)
    for i, name in enumerate("xyz"):
        values[name], values[f"normal_{name}"] = cloud.points[:, i], cloud.normals[:, i]
    values["rgb"], values["_"] = cloud.colours @ [65536, 256, 1], 3
    return values


def encoded(rows: np.ndarray, encoding: str, width: int = 40, height: int = 1) -> bytes:
    begin = header(rows, encoding, width, height)
    if encoding == "ascii":
        return begin + b"\n".join(b" ".join(str(x).encode() for x in np.hstack([np.ravel(v) for v in row.tolist()])) for row in rows)
    if encoding == "binary":
        return begin + rows.tobytes()
    plain = b"".join(rows[name].tobytes() for name in rows.dtype.names)
    packed = lzf.compress(plain)
    return begin + struct.pack("<II", len(packed), len(plain)) + packed


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_encoding_is_moved_with_its_fields(read, move, cloud, rows, matrix, encoding):
    source = read("a.pcd", encoded(rows, encoding))
    np.testing.assert_allclose(source.points, cloud.points, atol=1e-7)
    path, found = move(source, "b.pcd", matrix)
    np.testing.assert_allclose(found.points, cloud.points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-6)
    columns = found.content.columns
    normals = np.stack([columns[f"normal_{name}"] for name in "xyz"], -1)
    np.testing.assert_allclose(normals, cloud.normals @ matrix[:3, :3].T, atol=1e-6)
    np.testing.assert_array_equal(columns["rgb"], rows["rgb"])
    np.testing.assert_array_equal(columns["_"], rows["_"])
    assert b"\nVIEWPOINT 0 0 0 1 0 0 0\n" in path.read_bytes()


def test_back_references_of_lzf(read, cloud, rows):
    """Data that repeat compress to few bytes; literal runs alone would not."""
    repeated = np.repeat(rows[:2], 500)
    content = encoded(repeated, "binary_compressed", width=1000)
    assert len(content) < repeated.nbytes / 10
    np.testing.assert_allclose(read("a.pcd", content).points, np.repeat(cloud.points[:2], 500, axis=0), atol=1e-7)


def test_organised_clouds_keep_their_grid(read, move, cloud, rows, matrix):
    for name in "xyz":
        rows[name][::4] = np.nan
    content = encoded(rows, "binary", 8, 5)
    with pytest.raises(ValueError, match=r"10 of 40 points.*--drop-invalid"):
        read("a.pcd", content)
    source = read("a.pcd", content, "drop")
    assert (source.dropped, len(source.points)) == (10, 30)
    path, found = move(source, "b.pcd", matrix, "drop")
    assert b"\nWIDTH 8\nHEIGHT 5\n" in path.read_bytes()
    assert found.dropped == 10
    expected = cloud.points[np.arange(40) % 4 > 0] @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(found.points, expected, atol=1e-6)


def test_utm_coordinates_are_written_in_doubles(read, move, rows, to_utm):
    source = read("a.pcd", encoded(rows, "binary"))
    path, found = move(source, "b.pcd", to_utm)
    np.testing.assert_allclose(found.points, source.points @ to_utm[:3, :3].T + to_utm[:3, 3], rtol=0, atol=1e-8)
    assert b"SIZE 8 8 8 1 4" in path.read_bytes()


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_damage_is_named(read, rows, encoding):
    content = encoded(rows, encoding)
    cases = {
        "cut": content[:-9],
        "header only": header(rows, encoding, 40),
        "2147483648": content.replace(b"WIDTH 40", b"WIDTH 2147483648").replace(b"POINTS 40", b"POINTS 2147483648"),
        "fields": content.replace(b"FIELDS x y", b"FIELDS x w"),
        "lengths": content.replace(b"FIELDS x y", b"FIELDS x"),
        "TYPE": content.replace(b"TYPE F", b"TYPE Q"),
        "DATA": content.replace(b"DATA " + encoding.encode(), b"DATA zip"),
        "no line .*DATA": content[:100],
        "expected a PCD header": b"ply\nformat ascii 1.0\n",
    }
    for name, damaged in cases.items():
        message = name if name not in ("cut", "header only") else "expected"
        with pytest.raises(ValueError, match=message) as raised:
            read("a.pcd", damaged)
        assert "a.pcd: not a readable PCD file" in str(raised.value)


def test_damaged_compression(read, rows):
    content = encoded(rows, "binary_compressed")
    with pytest.raises(ValueError, match="not a readable PCD file"):
        read("a.pcd", content[:-40] + b"\xff" * 40)
