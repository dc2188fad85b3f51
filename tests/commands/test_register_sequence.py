"""`cmig register --sequence`: files of scans in, poses and one merged cloud out."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.data.formats.ply import Ply
from cmig_jax.data.formats.ply_elements import Element, Property
from cmig_jax.data.geometry_files import read_geometry

R = Rotation.from_euler("zyx", [30, 20, 10], degrees=True).as_matrix()
T = np.array([1.0, 2, 3])
BOXES = np.array([[0, 0, 0, 2, 1, 0.5], [0.7, 0.3, 0.7, 0.5, 0.4, 0.9], [-0.6, -0.35, 0.4, 0.5, 0.3, 0.3]])


def surface(count, seed):
    """Sample three boxes; return the points and their normals."""
    rng = np.random.default_rng(seed)
    box, axis, side = BOXES[rng.choice(3, count, p=[0.6, 0.25, 0.15])], rng.integers(0, 3, count), rng.choice([-1, 1], count)
    points, normals = rng.uniform(-0.5, 0.5, (count, 3)), np.zeros((count, 3))
    points[np.arange(count), axis], normals[np.arange(count), axis] = side / 2, side
    return box[:, :3] + points * box[:, 3:], normals


def colours_of(points):
    """Colour points by where they are on the body."""
    return (255 * (points - [-1, -1, -1]) / [2, 2, 3]).clip(0, 255).astype(np.uint8)


def write_ply(path, points, normals, colours):
    columns = {**dict(zip("xyz", points.T, strict=True)), **dict(zip(("nx", "ny", "nz"), normals.T, strict=True))}
    columns = {name: column.astype(np.float32) for name, column in columns.items()}
    columns |= dict(zip(("red", "green", "blue"), colours.T, strict=True))
    vertex = Element("vertex", len(points), tuple(Property(name, column.dtype.str[1:]) for name, column in columns.items()))
    path.write_bytes(Ply((), ((vertex, columns),)).moved(np.eye(4), ".ply"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two scans of a body, one of something else, one row without coordinates."""
    folder = tmp_path_factory.mktemp("scans")
    for name, seed, turn, shift in (("one", 0, np.eye(3), 0), ("two", 1, R, T)):
        points, normals = surface(700, seed)
        colours = colours_of(points)
        write_ply(folder / f"{name}.ply", points @ turn.T + shift, normals @ turn.T, colours)
    points, normals = surface(700, 2)
    points[5] = np.nan
    write_ply(folder / "three.ply", (points - T) @ R, normals @ R, colours_of(np.nan_to_num(points)))
    other = np.random.default_rng(5).normal(size=(500, 3))
    np.save(folder / "other.npy", other / np.linalg.norm(other, axis=1, keepdims=True))
    return folder


@pytest.fixture(scope="module")
def scans(folder):
    return [folder / name for name in ("one.ply", "two.ply", "other.npy", "three.ply")]


def test_scans_become_one_cloud_and_a_foreign_one_is_left_out(main, scans, tmp_path):
    out = tmp_path / "out"
    result = main("register", "--sequence", *scans, "--out", out, "--drop-invalid")
    assert result.returncode == 1, result.stderr
    assert f"{scans[2]}: left out: no trusted registration connects it to {scans[0]}" in result.stdout
    assert "three.ply: 1 points left out that are not finite" in result.stdout
    assert "3 of 4 scans in one frame" in result.stdout
    assert sorted(path.name for path in (out / "poses").iterdir()) == ["000_one.txt", "001_two.txt", "003_three.txt"]
    poses = json.loads((out / "poses.json").read_text())
    assert [scan["first_from_scan"] is None for scan in poses["scans"]] == [False, False, True, False]
    assert (poses["frame"], poses["trusted"], poses["scans"][2]["group"]) == (str(scans[0]), False, str(scans[2]))
    assert {row["used"] for row in poses["registrations"] if str(scans[2]) in row["source"] + row["target"]} == {False}
    second = np.loadtxt(out / "poses/001_two.txt")
    np.testing.assert_allclose(second, poses["scans"][1]["first_from_scan"], atol=1e-9)
    np.testing.assert_allclose(second[:3, :3], R.T, atol=0.03)
    np.testing.assert_allclose(second[:3, 3], -R.T @ T, atol=0.05)
    assert_merged(out / "merged.ply")


def assert_merged(path):
    """The cloud lies on the body; colours and normals are those of their places."""
    merged = read_geometry(path)
    columns = merged.content.elements[0][1]
    assert 700 < len(merged.points) < 2100
    off = np.abs(merged.points[:, None] - BOXES[:, :3]) - BOXES[:, 3:] / 2
    assert np.median(np.abs(off.max(axis=2)).min(axis=1)) < 0.02
    colours = np.stack([columns[name] for name in ("red", "green", "blue")], axis=1)
    assert colours.dtype == np.uint8
    assert np.median(np.abs(colours.astype(int) - colours_of(merged.points)).max(axis=1)) < 8
    normals = np.stack([columns[name] for name in ("nx", "ny", "nz")], axis=1)
    lengths = np.linalg.norm(normals, axis=1)
    assert np.median(np.abs(lengths - 1)) < 1e-3
    assert np.median(np.abs(normals).max(axis=1)) > 0.95, "the faces of the boxes are those of the axes"


def test_without_a_foreign_scan_all_is_trusted_and_quiet_prints_nothing(main, scans, folder, tmp_path):
    points = read_geometry(scans[1]).points
    np.savetxt(folder / "two.xyz", points)
    result = main("register", "--sequence", scans[0], folder / "two.xyz", "--out", tmp_path, "--quiet")
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    columns = read_geometry(tmp_path / "merged.ply").content.elements[0][1]
    assert list(columns) == ["x", "y", "z"], "one of the files has no colours"


def test_a_damaged_scan_is_named_and_nothing_is_written(main, scans, tmp_path):
    bad = tmp_path / "bad.ply"
    bad.write_bytes(b"ply\n")
    result = main("register", "--sequence", *scans, bad, "--out", tmp_path / "out", "--drop-invalid")
    assert result.returncode == 2
    assert result.stderr.startswith(f"error: {bad}: not a readable PLY file")
    assert not list((tmp_path / "out").iterdir())
