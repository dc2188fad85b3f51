"""Two files in, a transform out: what is printed and written, and what is refused."""

import json

import matplotlib.image
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cmig_jax.commands.register import _points

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


def test_a_mesh_is_aligned_as_a_mesh(main, run, tmp_path):
    for name, seed in (("source", 0), ("target", 1)):
        mesh = trimesh.creation.icosphere(2, 1 + 0.2 * seed)
        mesh.export(tmp_path / f"{name}.off")
    files = (tmp_path / "source.off", tmp_path / "target.off")
    done = main("register", *files, "--network", run, "--no-refine", "--aligned", tmp_path / "aligned.ply")
    assert done.returncode == 0, done.stderr
    aligned, source = (trimesh.load_mesh(tmp_path / name) for name in ("aligned.ply", "source.off"))
    assert aligned.faces.shape == source.faces.shape
    assert aligned.area == pytest.approx(source.area, rel=1e-5)
    assert "10000 points" in done.stdout


def test_a_mesh_and_its_copy_are_sampled_at_different_points():
    """Otherwise every point would meet itself, and the printed distances would say nothing."""
    mesh = trimesh.creation.icosphere(2)
    first, second = (_points(mesh, seed) for seed in (0, 1))
    assert np.linalg.norm(first - second, axis=1).min() > 0
    np.testing.assert_array_equal(first, _points(mesh, 0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("--transform", "T.csv"), "--transform T.csv: expected a file of .txt, .json, .npy in an existing folder"),
        (("--aligned", "a.gltf"), "--aligned a.gltf: expected a file of .ply, .pcd, .xyz"),
        (("--aligned", "none/a.ply"), "--aligned none/a.ply: expected a file of .ply, .pcd, .xyz"),
        (("--picture", "a.jpeg"), "--picture a.jpeg: expected a file of .png, .pdf, .svg"),
        (("--network", "none"), "none: expected a run folder"),
        (("--rotations", "181"), "rotations = 181.0: expected any, or an angle of 0 to 180 degrees"),
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
