"""The scripts of `examples/` run as a user runs them, on generated data."""

import dataclasses
import runpy
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cmig_jax import load
from cmig_jax.inference.load import Network
from cmig_jax.inference.predictor import Predictor
from cmig_jax.models.base import initial_variables
from cmig_jax.models.patches.flags import PatchFlags
from cmig_jax.training.state import build

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))


@pytest.fixture
def example(monkeypatch, capsys, tmp_path):
    """Return a function that runs an example in an empty folder: its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, *arguments: object) -> tuple[int, str]:
        path = EXAMPLES[0].with_name(f"{name}.py")
        monkeypatch.setattr(sys, "argv", [str(path), *map(str, arguments)])
        code = 0
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as exit:
            code = exit.code
        return code, capsys.readouterr().out

    return run


def body(points: int, seed: int) -> np.ndarray:
    """Sample a box with a ball on one corner and a bar on one side."""
    boxes = [trimesh.creation.box((2, 1, 0.5)), trimesh.creation.box((0.3, 1.5, 0.3)).apply_translation([-0.6, 0.5, 0.4])]
    parts = [*boxes, trimesh.creation.icosphere(2, 0.5).apply_translation([0.8, 0.3, 0.5])]
    return np.asarray(trimesh.sample.sample_surface(trimesh.util.concatenate(parts), points, seed=seed)[0])


R = Rotation.from_rotvec([0.4, -1.2, 0.9]).as_matrix()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_help_says_how_the_example_is_run(example, path):
    code, printed = example(path.stem, "--help")
    assert code == 0
    assert f"python examples/{path.name}" in printed


def test_two_scans(example, tmp_path):
    source, target = body(2_000, 0), body(1_500, 1) @ R.T + [5, 0, 0]
    np.savetxt(tmp_path / "source.xyz", np.c_[source, np.arange(2_000)])
    np.save(tmp_path / "target.npy", target)
    code, printed = example("two_scans", "source.xyz", "target.npy", "--out", "found")
    assert code == 0
    assert printed.startswith("trusted (confidence ")
    matrix = np.loadtxt(tmp_path / "found" / "target_from_source.txt")
    np.testing.assert_allclose(matrix[:3, :3], R, atol=0.05)
    aligned = np.loadtxt(tmp_path / "found" / "aligned.xyz")
    np.testing.assert_allclose(aligned[:, :3], source @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-6)
    np.testing.assert_array_equal(aligned[:, 3], np.arange(2_000))
    assert (tmp_path / "found" / "pair.png").stat().st_size > 10_000
    np.save(tmp_path / "other.npy", np.random.default_rng(0).normal(size=(1_500, 3)))
    code, printed = example("two_scans", "source.xyz", "other.npy")
    assert code == 1
    assert "Do not use this transform unseen" in printed


def test_beside_open3d_and_trimesh(example):
    code, printed = example("beside_open3d_and_trimesh")
    assert code == 0
    lines = printed.splitlines()
    assert [line.split(":")[0] for line in lines] == ["trimesh", "Open3D"]
    assert float(lines[0].split()[-1]) < 0.1
    assert "not installed" in lines[1] or float(lines[1].split()[-1]) < 0.1


def test_a_folder_to_one_model(example, tmp_path):
    whole, rng = body(4_000, 0), np.random.default_rng(1)
    for i, direction in enumerate(([1, 0.3, 0.2], [-0.2, 1, 0.2], [-1, 0.1, -0.3])):
        seen = body(4_000, i) if i else whole
        seen = seen[seen @ direction > np.quantile(seen @ direction, 0.25)]
        np.save(tmp_path / f"{i}.npy", seen @ Rotation.random(rng=rng).as_matrix().T if i else seen)
    code, printed = example("folder_to_model", tmp_path)
    assert code == 0, printed
    model = np.asarray(trimesh.load(tmp_path / "model.ply").vertices)
    distance = np.linalg.norm(whole[::10, None] - model[None], axis=2).min(axis=1)
    assert np.quantile(distance, 0.95) < 0.1, "the model has what the first scan does not show"


def test_fine_tuning_starts_from_the_given_weights(example, tiny, tmp_path):
    for category in ("box", "cylinder"):
        (tmp_path / "objects" / category).mkdir(parents=True)
        for i in range(6):
            size = np.random.default_rng(i).uniform(0.5, 2, 3)
            mesh = trimesh.creation.box(size) if category == "box" else trimesh.creation.cylinder(size[0], size[1])
            mesh.export(tmp_path / "objects" / category / f"{i}.ply")
    small = PatchFlags(k=4, patch_widths=(4,), dim=8, layers=1, heads=2, feed_forward=8, patches=12, test_patches=12, passes=1)
    tiny = dataclasses.replace(tiny, model=small)  # of the packaged network's kind
    module = build(tiny)
    variables = jax.jit(lambda key: initial_variables(module, tiny.model.needs, key))(jax.random.key(1))
    network = Network(dataclasses.replace(tiny, name="start"), variables, Predictor(module, 1), 0)
    functions = runpy.run_path(str(EXAMPLES[0].with_name("fine_tune.py")))
    functions["start_from"](network, network.config, tmp_path / "start")
    for old, new in zip(jax.tree.leaves(variables), jax.tree.leaves(load(tmp_path / "start").variables), strict=True):
        np.testing.assert_array_equal(old, new)

    command = ("fine_tune", "objects", "runs/mine", "--weights", "start", "--batch", "4", "--learning-rate", "1e-9")
    code, printed = example(*command, "--epochs", "1")
    assert code == 0
    assert "--network runs/mine" in printed
    tuned = load(tmp_path / "runs" / "mine", "last")
    assert tuned.step == 2
    assert (tuned.config.data.source, tuned.config.optim.epochs) == ("meshes", 1)
    for old, new in zip(jax.tree.leaves(variables["params"]), jax.tree.leaves(tuned.variables["params"]), strict=True):
        np.testing.assert_allclose(old, new, atol=1e-7)
