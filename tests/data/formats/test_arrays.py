"""NPY, NPZ and KITTI's `.bin`: which columns are the points, and what stays after a move."""

import io

import numpy as np
import pytest


def npy(array: np.ndarray, allow_pickle=False) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=allow_pickle)
    return file.getvalue()


def npz(**arrays) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def structured(cloud, kind="f4") -> np.ndarray:
    rows = np.zeros(40, [("ring", "u2"), ("X", kind), ("Y", kind), ("Z", kind), ("nx", "f4"), ("ny", "f4"), ("nz", "f4"), ("name", "U4")])
    for i, name in enumerate("xyz"):
        rows[name.upper()], rows[f"n{name}"] = cloud.points[:, i], cloud.normals[:, i]
    rows["ring"], rows["name"] = np.arange(40), "tree"
    return rows


def moved(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def test_shapes_of_arrays(read, cloud):
    points = cloud.points
    for array in (points, np.asfortranarray(points), points.astype(">f8"), np.c_[points, cloud.colours], points.reshape(8, 5, 3)):
        np.testing.assert_array_equal(read("a.npy", npy(array)).points, points)
    np.testing.assert_array_equal(read("a.npy", npy((points * 1e4).round().astype(np.int32))).points, (points * 1e4).round())
    np.testing.assert_array_equal(read("a.npy", npy(structured(cloud, "f8"))).points, points)
    np.testing.assert_array_equal(read("a.npy", npy(structured(cloud, "f8").reshape(8, 5))).points, points)


def test_archives(read, cloud):
    for arrays in ({"anything": cloud.points}, {"points": cloud.points, "other": np.zeros(3)}, {"other": np.zeros(3), "XYZ": cloud.points}):
        np.testing.assert_array_equal(read("a.npz", npz(**arrays)).points, cloud.points)
    with pytest.raises(ValueError, match="arrays: a, b; expected one array, or one called points or xyz"):
        read("a.npz", npz(a=cloud.points, b=cloud.points))


def test_velodyne(read, move, cloud, matrix, to_utm):
    rows = np.c_[cloud.points, cloud.colours].astype("<f4")
    for name, columns in (("a.bin", 4), ("a.pcd.bin", 5)):
        source = read(name, rows[:, :columns].tobytes())
        np.testing.assert_allclose(source.points, cloud.points, atol=1e-7)
        path, found = move(source, "b" + name[1:], matrix)
        np.testing.assert_allclose(found.points, moved(matrix, cloud.points), atol=1e-6)
        np.testing.assert_array_equal(np.fromfile(path, "<f4").reshape(40, columns)[:, 3:], rows[:, 3:columns])
        with pytest.raises(ValueError, match=r"single precision, which moves these coordinates by up to 0\.\d+; expected a file of .npy"):
            move(source, "c" + name[1:], to_utm)


def test_a_move_keeps_the_columns(read, move, cloud, matrix):
    for columns, expected in ((cloud.colours, cloud.colours), (cloud.normals, cloud.normals @ matrix[:3, :3].T)):
        array = np.c_[cloud.points, columns].astype(np.float32).reshape(8, 5, 6)
        path, _ = move(read("a.npy", npy(array)), "b.npy", matrix)
        found = np.load(path)
        assert (found.shape, found.dtype) == ((8, 5, 6), np.float32)
        np.testing.assert_allclose(found.reshape(40, 6), np.c_[moved(matrix, cloud.points), expected], atol=1e-5)


def test_a_move_keeps_the_fields(read, move, cloud, matrix):
    source = structured(cloud)
    path, found = move(read("a.npy", npy(source)), "b.npy", matrix)
    np.testing.assert_allclose(found.points, moved(matrix, cloud.points), atol=1e-6)
    rows = np.load(path)
    assert rows.dtype == source.dtype
    np.testing.assert_array_equal(rows[["ring", "name"]], source[["ring", "name"]])
    np.testing.assert_allclose(np.stack([rows["nx"], rows["ny"], rows["nz"]], -1), cloud.normals @ matrix[:3, :3].T, atol=1e-6)


def test_a_move_keeps_the_archive(read, move, cloud, matrix):
    labels = np.arange(40)
    path, found = move(read("a.npz", npz(points=cloud.points, normals=cloud.normals, labels=labels)), "b.npz", matrix)
    np.testing.assert_allclose(found.points, moved(matrix, cloud.points), atol=1e-14)
    with np.load(path) as arrays:
        np.testing.assert_allclose(arrays["normals"], cloud.normals @ matrix[:3, :3].T, atol=1e-14)
        np.testing.assert_array_equal(arrays["labels"], labels)


def test_types_of_a_moved_array(read, move, cloud, matrix, to_utm):
    for kind, pose, expected in (("f4", matrix, "f4"), ("f4", to_utm, "f8"), ("f8", matrix, "f8"), ("i4", matrix, "f8")):
        source = read("a.npy", npy((cloud.points * 100).astype(kind)))
        path, found = move(source, "b.npy", pose)
        assert np.load(path).dtype == expected
        np.testing.assert_allclose(found.points, moved(pose, source.points), atol=1e-4 if expected == "f4" else 1e-8)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npy", npy(np.zeros((5, 2))), r"shape \(5, 2\), float64; expected \[N, 3\] real numbers"),
        ("a.npy", npy(np.zeros((3, 50))), r"expected a row for each point: save array\.T"),
        ("a.npy", npy(np.zeros(9)), "expected"),
        ("a.npy", npy(np.zeros((5, 3), complex)), "complex128; expected"),
        ("a.npy", npy(np.zeros((5, 3), "U3")), "expected .* real numbers"),
        ("a.npy", npy(np.array([[1, 2, None]]), allow_pickle=True), "Python objects; expected numbers"),
        ("a.npy", npy(np.zeros(4, [("x", "f4"), ("y", "f4")])), "fields x, y; expected x, y and z"),
        ("a.npy", npy(np.zeros((0, 3))), "0 points; expected at least 1"),
        ("a.npy", npy(np.zeros((40, 3)))[:-1], r"959 bytes of data; expected 960 for shape \(40, 3\)"),
        ("a.npy", npy(np.zeros((40, 3))).replace(b"(40, 3), }        ", b"(2147483648, 3), }"), "expected 51539607552"),
        ("a.npy", npy(np.zeros((40, 3)))[:60], "not a readable NPY file"),
        ("a.npz", npz(points=np.zeros((40, 3)))[:-30], "not a readable NPZ file"),
        ("a.npz", npy(np.zeros((40, 3))), "not a readable NPZ file.*it begins like a file of .npy"),
        ("a.bin", b"\0" * 30, "30 bytes; expected rows of 4 float32"),
        ("a.bin", b"1.5 2.5 3.5 4.5\n" * 4, "text; expected rows of 4 float32"),
        ("a.pcd.bin", b"\0" * 32, "32 bytes; expected rows of 5 float32"),
    ],
)
def test_damage_is_named(read, tmp_path, name, content, message):
    with pytest.raises(ValueError, match=message) as raised:
        read(name, content)
    assert str(raised.value).startswith(str(tmp_path / name))
