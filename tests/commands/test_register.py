"""Two files in, a transform out: what is printed and written, and what is refused."""

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
    done = main("register", *files, "--network", run, *outputs)
    assert done.returncode == 0, done.stderr
    written = transform.read_text().splitlines()
    assert "\n".join(written) in done.stdout
    assert "600 points" in done.stdout
    T, source = np.loadtxt(transform), np.load(files[0])
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(source @ T[:3, :3].T + T[:3, 3], np.load(aligned), atol=1e-3)
    assert np.abs(np.load(aligned) - np.load(files[1])).max() < 10
    assert matplotlib.image.imread(picture).std() > 0.05
    assert {path.name for path in tmp_path.iterdir()} == {"source.npy", "target.npy", "T.txt", "aligned.npy", "pair.png"}


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
        (("--transform", "T.json"), "--transform T.json: expected a file of .txt in an existing folder"),
        (("--aligned", "none/a.ply"), "--aligned none/a.ply: expected a file of .ply, .npy in an existing folder"),
        (("--picture", "a.jpeg"), "--picture a.jpeg: expected a file of .png, .pdf, .svg"),
        (("--network", "none"), "none: expected a run folder"),
        (("--points", "2"), "points = 2: expected at least 16"),
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
