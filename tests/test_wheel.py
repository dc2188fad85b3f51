"""A wheel, installed outside the checkout, has all its files: presets, weights and the page's parts.

Libraries come from the present environment, which saves minutes; `test_imports.py` checks that the project declares those that it uses.
"""

import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def cmig(tmp_path_factory):
    """Build the wheel, install it, and return a function that runs `cmig` outside the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in ("cmig_jax", "configs"):  # a build leaves files beside its sources
        shutil.copytree(ROOT / name, folder / "sources" / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / "sources")
    pip = [sys.executable, "-m", "pip"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(folder / "sources")]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    venv.create(folder / "venv", with_pip=False, symlinks=True)
    python = folder / "venv" / "bin" / "python"
    place = Path(subprocess.check_output([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], text=True).strip())
    subprocess.run([*pip, "--python", str(python), "install", "--no-deps", str(wheel)], check=True, capture_output=True)
    (place / "libraries.pth").write_text(sysconfig.get_path("purelib"))

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [str(folder / "venv" / "bin" / "cmig"), *map(str, arguments)]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)

    run.folder = folder
    return run


def test_it_registers_two_files(cmig):
    target = np.random.default_rng(0).normal(size=(500, 3)) * [1, 0.6, 0.3]
    R = Rotation.from_euler("z", 5, degrees=True).as_matrix()
    np.save(cmig.folder / "source.npy", (target - [0.1, 0, 0]) @ R)
    np.save(cmig.folder / "target.npy", target)
    done = cmig("register", "source.npy", "target.npy", "--transform", "T.txt")
    assert done.returncode == 0, done.stderr
    np.testing.assert_allclose(np.loadtxt(cmig.folder / "T.txt")[:3, :3], R, atol=0.02)


def test_it_trains_a_preset_and_reports(cmig):
    data = ["--data.shapes", 4, "--data.points", 64, "--optim.epochs", 1, "--optim.validate-every", 1]
    network = ["--model.layers", 1, "--model.patches", 16, "--model.test-patches", 16, "--model.passes", 1]
    done = cmig("train", "own-clouds", *data, *network)
    assert done.returncode == 0, done.stderr
    done = cmig("evaluate", "runs/own-clouds", "--limit", 4, "--batch", 4, "--report")
    assert done.returncode == 0, done.stderr
    assert (cmig.folder / "runs" / "own-clouds" / "evaluation" / "report.html").stat().st_size > 10_000
    assert "table8" in cmig("experiments", "list").stdout


def test_nothing_but_the_package_is_installed(cmig):
    place = next(cmig.folder.glob("venv/lib/python*/site-packages"))
    assert {path.name.split("-")[0] for path in place.iterdir()} == {"cmig_jax", "libraries.pth"}
    assert (place / "cmig_jax" / "py.typed").exists()
