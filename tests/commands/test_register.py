"""Two files in, a transform out: what is printed and written, and what is refused."""

import json
import os

import matplotlib.image
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cmig_jax.commands.register_inputs import points_of

FAR = np.array([500_000.0, 4_000_000.0, 100.0])
"""Where geographic coordinates are, in metres: single precision has a quarter of one there."""


@pytest.fixture(scope="module")
def run(trained):
    folder, done = trained
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def moved():
    """A cloud of three planes, metres wide, and the same moved by a little."""
    rng = np.random.default_rng(0)
    cloud = rng.uniform(-1, 1, (600, 3)) * [4, 3, 2]
    cloud[np.arange(600), np.arange(600) % 3] = 0  # three planes
    R = Rotation.from_euler("zyx", [3, 2, 1], degrees=True).as_matrix()
    return cloud, cloud @ R.T + [0.02, 0.01, 0.03]


@pytest.fixture
def files(tmp_path, moved):
    source, target = moved
    np.save(tmp_path / "source.npy", source + FAR)
    np.save(tmp_path / "target.npy", target + FAR)
    return tmp_path / "source.npy", tmp_path / "target.npy"


def test_the_transform_is_printed_and_written_and_takes_the_source_to_the_aligned_file(main, run, files, tmp_path):
    transform, aligned, picture = tmp_path / "T.txt", tmp_path / "aligned.npy", tmp_path / "pair.png"
    outputs = ("--transform", transform, "--aligned", aligned, "--picture", picture)
    done = main("register", *files, *outputs)
    assert done.returncode == 0, done.stderr
    assert "600 points" in done.stdout
    assert "trusted (confidence " in done.stdout
    T, source = np.loadtxt(transform), np.load(files[0])
    assert f"{T[0, 0]:.8g}" in done.stdout
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(source @ T[:3, :3].T + T[:3, 3], np.load(aligned), atol=1e-3)
    assert np.abs(np.load(aligned) - np.load(files[1])).max() < 0.1
    assert matplotlib.image.imread(picture).std() > 0.05
    assert {path.name for path in tmp_path.iterdir()} == {"source.npy", "target.npy", "T.txt", "aligned.npy", "pair.png"}


def test_clouds_that_do_not_belong_together_end_with_1_and_files_are_written(main, files, tmp_path):
    np.save(files[1], np.random.default_rng(1).normal(size=(500, 3)))
    done = main("register", *files, "--json", "--transform", tmp_path / "T.json")
    assert done.returncode == 1, done.stderr
    result = json.loads(done.stdout)
    assert result == json.loads((tmp_path / "T.json").read_text())
    assert (result["trusted"], np.shape(result["target_from_source"])) == (False, (4, 4))
    quiet = main("register", *files, "--quiet", "--transform", tmp_path / "T.npy")
    assert (quiet.returncode, quiet.stdout) == (1, "")
    np.testing.assert_allclose(np.load(tmp_path / "T.npy"), result["target_from_source"], atol=1e-6)


def test_the_view_shows_both_files_and_the_printed_transform(main, files, tmp_path):
    done = main("register", *files, "--json", "--view", tmp_path / "pair.html")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "pair.html").read_text()
    assert "<h1>source.npy onto target.npy</h1>" in page
    full = page.split('data-full="')[1].split('"')[0]
    np.testing.assert_allclose(np.array(full.split(), float).reshape(4, 4), json.loads(done.stdout)["target_from_source"], rtol=1e-12)


def test_a_mesh_is_aligned_as_a_mesh(main, run, tmp_path):
    for name, seed in (("source", 0), ("target", 1)):
        mesh = trimesh.creation.icosphere(2, 1 + 0.2 * seed)
        mesh.export(tmp_path / f"{name}.off")
    files = (tmp_path / "source.off", tmp_path / "target.off")
    done = main("register", *files, "--network", run, "--no-refine", "--aligned", tmp_path / "aligned.ply")
    assert (done.returncode, done.stderr) == (1, "")
    assert "not trusted" in done.stdout.lower()
    aligned, source = (trimesh.load_mesh(tmp_path / name) for name in ("aligned.ply", "source.off"))
    assert aligned.faces.shape == source.faces.shape
    assert aligned.area == pytest.approx(source.area, rel=1e-5)
    assert "10000 points" in done.stdout


def test_a_mesh_and_its_copy_are_sampled_at_different_points():
    """Otherwise every point would meet itself, and the printed distances would say nothing."""
    mesh = trimesh.creation.icosphere(2)
    first, second = (points_of(mesh, seed) for seed in (0, 1))
    assert np.linalg.norm(first - second, axis=1).min() > 0
    np.testing.assert_array_equal(first, points_of(mesh, 0))


def test_line_ends_and_formats_of_one_mesh_change_nothing(main, tmp_path):
    """Coordinates differ by 5e-8 between OFF (decimals) and PLY (single precision)."""
    ball = trimesh.creation.icosphere(2, 0.6).apply_translation([1, 0.3, 0.7])
    body = trimesh.util.concatenate([trimesh.creation.box((2, 1, 0.5)), ball])
    turn = trimesh.transformations.rotation_matrix(1.9, [1, 2, -1])
    body.copy().apply_transform(turn).export(tmp_path / "target.ply")
    body.export(tmp_path / "a.ply")
    text = body.export(file_type="off")
    (tmp_path / "a.off").write_bytes(text.encode())
    (tmp_path / "b.off").write_bytes(text.replace("\n", "\r\n").encode())
    found = []
    for name in ("a.ply", "a.off", "b.off"):
        done = main("register", tmp_path / name, tmp_path / "target.ply", "--json")
        found.append(json.loads(done.stdout)["target_from_source"])
        np.testing.assert_allclose(found[-1], turn, atol=0.01)
    np.testing.assert_allclose(found[1], found[0], atol=1e-4)
    np.testing.assert_array_equal(found[2], found[1])


def test_units_of_files_are_said_and_compared(main, tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    for name in ("a.glb", "b.3mf", "c.stl"):
        box.export(tmp_path / name)
    flags = ("--rotations", 1)
    done = main("register", tmp_path / "a.glb", tmp_path / "b.3mf", *flags)
    assert "a.glb: coordinates in meters, taken as they are\n" in done.stdout
    assert f"warning: {tmp_path / 'a.glb'} is in meters, {tmp_path / 'b.3mf'} in millimeter; expected the same unit\n" in done.stderr
    assert "warning" not in main("register", tmp_path / "c.stl", tmp_path / "b.3mf", *flags).stderr
    assert "warning" not in main("register", tmp_path / "b.3mf", tmp_path / "b.3mf", *flags).stderr


@pytest.mark.parametrize("name", ["transform", "aligned", "picture", "view"])
def test_an_output_that_cannot_be_written_is_said_before_the_work(main, files, tmp_path, monkeypatch, name):
    suffix = {"transform": ".txt", "aligned": ".ply", "picture": ".png", "view": ".html"}[name]
    (tmp_path / f"folder{suffix}").mkdir()
    done = main("register", *files, f"--{name}", tmp_path / f"folder{suffix}")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: --{name} {tmp_path / f'folder{suffix}'}: a folder; expected a file to write\n"
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write everywhere
    done = main("register", *files, f"--{name}", tmp_path / f"a{suffix}")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: --{name} {tmp_path / f'a{suffix}'}: no permission to write; expected a file to write\n"
    assert {path.name for path in tmp_path.iterdir()} == {"source.npy", "target.npy", f"folder{suffix}"}


def test_an_error_while_writing_leaves_the_files_that_were_there(main, files, tmp_path, monkeypatch):
    (tmp_path / "T.txt").write_text("old")

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    done = main("register", *files, "--transform", tmp_path / "T.txt")
    assert done.returncode == 2
    assert "No space left on device" in done.stderr
    assert {path.name: path.stat().st_size for path in tmp_path.glob("T*")} == {"T.txt": 3}


def test_a_scan_that_was_turned_about_the_vertical(main, files):
    done = main("register", *files, "--rotations", "yaw", "--up", "z", "--json")
    assert json.loads(done.stdout)["target_from_source"][2][2] > 0.98


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("--transform", "T.csv"), "--transform T.csv: expected a file of .txt, .json, .npy in an existing folder"),
        (("--aligned", "a.gltf"), "--aligned a.gltf: expected a file of .ply, .pcd, .xyz"),
        (("--aligned", "none/a.ply"), "--aligned none/a.ply: expected a file of .ply, .pcd, .xyz"),
        (("--picture", "a.jpeg"), "--picture a.jpeg: expected a file of .png, .pdf, .svg"),
        (("--view", "a.htm"), "--view a.htm: expected a file of .html"),
        (("--network", "none"), "none: expected a run folder"),
        (("--rotations", "181"), "rotations = 181.0: expected any, yaw, or an angle of 0 to 180 degrees"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(main, run, files, tmp_path, change, message):
    network = () if "--network" in change else ("--network", run)
    done = main("register", *files, *network, *change)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"source.npy", "target.npy"}


def test_a_file_that_is_no_cloud_is_named(main, run, files, tmp_path):
    (tmp_path / "source.npy").write_bytes(b"no array")
    done = main("register", *files, "--network", run)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {tmp_path / 'source.npy'}: not a readable NPY file")


def test_rows_that_are_not_finite_are_left_out_and_counted(main, run, moved, tmp_path):
    """A depth camera's cloud with an attribute: the aligned file has all rows, and the attribute."""
    source, target = moved
    rows = np.c_[source, np.arange(600)]
    rows[::5, :3] = np.nan
    np.savetxt(tmp_path / "source.xyz", rows)
    np.save(tmp_path / "target.npy", target)
    command = ("register", tmp_path / "source.xyz", tmp_path / "target.npy", "--network", run)
    done = main(*command)
    assert done.returncode == 2
    assert "120 of 600 points" in done.stderr
    assert "--drop-invalid" in done.stderr
    done = main(*command, "--drop-invalid", "--aligned", tmp_path / "aligned.xyz", "--transform", tmp_path / "T.txt")
    assert done.returncode == 0, done.stderr
    assert "source.xyz: 120 points left out" in done.stdout
    assert "source.xyz: 480 points" in done.stdout
    aligned, T = np.loadtxt(tmp_path / "aligned.xyz"), np.loadtxt(tmp_path / "T.txt")
    np.testing.assert_allclose(aligned[:, :3], rows[:, :3] @ T[:3, :3].T + T[:3, 3], atol=1e-7)
    np.testing.assert_array_equal(aligned[:, 3], np.arange(600))
