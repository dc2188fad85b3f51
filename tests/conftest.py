"""Eight virtual CPU devices, programs compiled quickly, rank promotion an error; and a network, clouds and a run that take seconds."""

import dataclasses
import functools
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import numpy as np
import pytest

os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=8 --xla_backend_optimization_level=1"
os.environ["JAX_PLATFORMS"] = "cpu"
import jax

from cmig_jax import cli
from cmig_jax.config import Config, DataConfig, OptimConfig, ViewsConfig
from cmig_jax.config_json import flat
from cmig_jax.data.prepare import prepare
from cmig_jax.experiments.plan import command_line as as_flags
from cmig_jax.models.cmignet.flags import (
    CMIGNetFlags,
    FusionFlags,
    ImageFlags,
    KeypointsFlags,
    LossFlags,
    MatchingFlags,
    PointsFlags,
)
from configs.catalogue import catalogue

jax.config.update("jax_numpy_rank_promotion", "raise")

ROOT = Path(__file__).parents[1]
CATEGORIES = ("bottle", "bowl", "chair", "lamp")


def pytest_configure(config: pytest.Config) -> None:
    """Compile each program once for all of pytest's processes and the command lines that tests start: many tests need the same few."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.TemporaryDirectory(prefix="cmig_jax-compiled-", ignore_cleanup_errors=True)
        config.add_cleanup(folder.cleanup)
        os.environ["JAX_COMPILATION_CACHE_DIR"] = folder.name
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])


@pytest.fixture(scope="session")
def clouds(tmp_path_factory) -> Path:
    """ModelNet40 as people have it, but of 4 categories, 6 objects to train on and 2 to test on each, 64 points."""
    root, rng = tmp_path_factory.mktemp("clouds"), np.random.default_rng(0)
    (root / "shape_names.txt").write_text("\n".join(CATEGORIES) + "\n")
    for split, each in (("train", 6), ("test", 2)):
        labels = np.repeat(np.arange(len(CATEGORIES)), each)
        points = rng.normal(size=(len(labels), 64, 3)) * rng.uniform(0.3, 1, (len(labels), 1, 3))
        points /= np.linalg.norm(points, axis=-1).max(axis=1)[:, None, None]
        with h5py.File(root / f"ply_data_{split}0.h5", "w") as file:
            file["data"], file["label"] = points.astype(np.float32), labels[:, None].astype(np.uint8)
    return root


@pytest.fixture(scope="session")
def tiny(clouds, tmp_path_factory) -> Config:
    """A network and data of which everything takes seconds; 18 training objects, so 2 steps an epoch."""
    config = Config(
        name="tiny",
        data=DataConfig(source="modelnet40-hdf5", root=str(clouds), points=48, validation=0.25),
        views=ViewsConfig(of="both", count=6, size=16, layout="axes"),
        model=CMIGNetFlags(
            points=PointsFlags(k=6, widths=(8, 8), dim=16),
            image=ImageFlags(widths=(4, 16), blocks=(1, 1)),
            fusion=FusionFlags(image="views", heads=2, feed_forward=16),
            keypoints=KeypointsFlags(count=16),
            matching=MatchingFlags(iterations=1, feature_widths=(8,), coordinate_widths=(8,)),
            loss=LossFlags(cross_modal="nt-xent", match_mean="positive"),
        ),
        optim=OptimConfig(learning_rate=1e-3, epochs=4, batch=8, milestones=(2,), validate_every=2),
    )
    prepared = prepare(config.data, config.views, tmp_path_factory.mktemp("prepared"), workers=1, progress=False)
    return dataclasses.replace(config, data=dataclasses.replace(config.data, prepared=str(prepared)))


@pytest.fixture(scope="session")
def random_variables():
    """Return a function that draws variables with NumPy: no initialisation to compile, and no trivial normalisation."""

    def draw(module, *inputs, seed=0, dtype=np.float64, **options):
        rng = np.random.default_rng(seed)

        def leaf(path, shape):
            if path[-1].key in ("scale", "var"):
                return rng.uniform(0.5, 1.5, shape.shape).astype(dtype)
            fan_in = np.prod(shape.shape[:-1]) if path[-1].key == "kernel" else 10
            return (rng.normal(size=shape.shape) / np.sqrt(fan_in)).astype(dtype)

        shapes = jax.eval_shape(functools.partial(module.init, **options), jax.random.key(0), *inputs)
        return jax.tree_util.tree_map_with_path(leaf, shapes)

    return draw


@pytest.fixture(scope="session")
def command_line():
    """Run one of the scripts as a user does: its exit code and what it printed."""

    def run(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(ROOT / script), *map(str, arguments)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
        return subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=600, check=False)

    return run


@pytest.fixture
def main(capsys, monkeypatch):
    """Run a command in this process, which saves the seconds that a process takes to start."""
    monkeypatch.setenv("COLUMNS", "100")

    def run(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
        try:
            code = cli.main([name, *map(str, arguments)], catalogue)
        except SystemExit as exit:
            code = exit.code
        printed = capsys.readouterr()
        return subprocess.CompletedProcess(arguments, code, printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def flags():
    """Write a config as the flags of a command line."""
    return lambda config: list(as_flags(flat(config)))


@pytest.fixture(scope="session")
def trained(command_line, flags, tiny, tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """A run from the command line: its folder, and what it printed."""
    runs = tmp_path_factory.mktemp("runs")
    return runs / "tiny", command_line("train.py", "quickstart", *flags(tiny), "--runs", runs, "--devices", 1)
