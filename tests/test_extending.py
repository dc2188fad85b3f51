"""A network and a data source that are declared here go through everything a user does, without a change anywhere else.

`docs/extending.md` shows both declarations.
"""

import functools
import json
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax import Array

from cmig_jax import cli, load, register
from cmig_jax.config import ComputeConfig, Config, DataConfig, ModelFlags, Needs, OptimConfig, ViewsConfig, check
from cmig_jax.data.prepare import prepare
from cmig_jax.data.raw import RawDataset, RawObject, Source
from cmig_jax.data.shards import Shards
from cmig_jax.data.sources import SOURCES
from cmig_jax.experiments.schema import Catalogue, Experiment, Row
from cmig_jax.geometry.rotations import rotation_from_quaternion
from cmig_jax.models.base import Model
from cmig_jax.models.networks import NETWORKS
from cmig_jax.structs import Batch, Prediction
from cmig_jax.training import loop
from cmig_jax.transform import RigidTransform

# --- a network


@dataclass(frozen=True)
class ToyFlags(ModelFlags):
    """A pose regressed from the largest features of each cloud."""

    network: ClassVar[str] = "toy"
    title: ClassVar[str] = "Toy"
    width: int = 16
    """Channels."""

    def __post_init__(self) -> None:
        check([(f"model.width = {self.width}", self.width >= 1, "at least 1")])

    @property
    def needs(self) -> Needs:
        """A few points."""
        return Needs(points=4, training_points=4)


class ToyNetwork(nn.Module):
    """Two layers for every point, a maximum over the points, and a layer for the pose."""

    flags: ToyFlags
    compute: ComputeConfig

    @nn.compact
    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> Prediction:
        """Return the pose."""
        encode = nn.Sequential([nn.Dense(self.flags.width), nn.relu, nn.Dense(self.flags.width)])
        source, target = (jnp.max(encode(points), axis=1) for points in (batch.source, batch.target))
        pose = nn.Dense(7)(jnp.concatenate([source, target], axis=-1))
        quaternion = jnp.concatenate([1 + pose[:, :1], pose[:, 1:4]], axis=-1)
        return Prediction(RigidTransform(R=rotation_from_quaternion(quaternion), t=pose[:, 4:]))


def toy_losses(prediction: Prediction, batch: Batch, flags: ToyFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return the mean squared distance of the source's points from where they belong."""
    assert batch.target_from_source is not None
    offset = prediction.target_from_source.apply(batch.source) - batch.target_from_source.apply(batch.source)
    return {"distance": jnp.mean(jnp.sum(offset**2, axis=-1))}


TOY = Model(flags=ToyFlags, build=ToyNetwork, losses=toy_losses)

# --- a data source

CATEGORIES = ("box", "capsule", "cloud")


def open_solids(data: DataConfig) -> RawDataset:
    """Open `data.shapes` objects per category to train on and two to test on."""
    objects = []
    for split, count in (("train", data.shapes), ("test", 2)):
        for label, category in enumerate(CATEGORIES):
            for i in range(count):
                read = {
                    "box": functools.partial(trimesh.creation.box, (1 + 0.1 * i, 2, 3)),
                    "capsule": functools.partial(trimesh.creation.capsule, 1 + 0.1 * i, 0.4, count=(8, 8)),
                    "cloud": functools.partial(np.multiply, np.random.default_rng(i).normal(size=(2500, 3)), (1, 2, 3)),
                }
                objects.append(RawObject(f"{split}/{category}-{i}", label, split, read[category]))
    return RawDataset(CATEGORIES, tuple(objects))


SOLIDS = Source("solids", open_solids, folder=None, flags=("shapes",))

# --- what a user does with them

VIEWS = ViewsConfig(count=6, size=16, layout="axes")


def toy() -> Config:
    """The toy network on the toy source."""
    return Config(
        name="toy",
        data=DataConfig(source="solids", shapes=6, points=64, validation=0.25),
        views=VIEWS,
        model=ToyFlags(),
        optim=OptimConfig(learning_rate=3e-3, epochs=60, batch=6, milestones=(40,), validate_every=30),
    )


TABLE = Experiment("two widths", {"data.source": "solids"}, (Row("16", "toy"), Row("32", "toy", {"model.width": 32})))
CATALOGUE = Catalogue(presets={"toy": toy}, scales={"full": lambda config: config}, experiments={"table": TABLE})


def cmig(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments], lambda: CATALOGUE)


@pytest.fixture(scope="module")
def declared():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(NETWORKS, TOY.name, TOY)
        patch.setitem(SOURCES, SOLIDS.name, SOLIDS)
        yield


@pytest.fixture(scope="module")
def run(declared, tmp_path_factory) -> Path:
    """A training from the command line, its run folder."""
    folder = tmp_path_factory.mktemp("toy")
    prepared = prepare(toy().data, VIEWS, folder / "prepared", workers=1, progress=False)
    assert cmig("train", "toy", "--data.prepared", prepared, "--runs", folder, "--devices", 1) == 0
    return folder / "toy"


def test_the_network_trains(run):
    first, *_, last = [json.loads(line)["distance"] for line in (run / "log.jsonl").read_text().splitlines() if "distance" in line]
    assert last < 0.5 * first


def test_it_resumes_where_it_stopped(run, tmp_path, monkeypatch):
    config, to_device, batches = load(run, "last").config, loop.to_device, iter(range(1000))

    def interrupted(*arguments):
        if next(batches) == 100:
            raise KeyboardInterrupt
        return to_device(*arguments)

    monkeypatch.setattr(loop, "to_device", interrupted)
    with pytest.raises(KeyboardInterrupt):
        loop.train(config, tmp_path / "toy", progress=False, devices=1)
    monkeypatch.undo()
    loop.train(config, tmp_path / "toy", resume=True, progress=False, devices=1)
    jax.tree.map(np.testing.assert_array_equal, load(tmp_path / "toy", "last").variables, load(run, "last").variables)


def test_it_is_evaluated_beside_the_baselines_with_a_report(run, capsys):
    assert cmig("evaluate", run, "--report", "--report-pairs", 2) == 0
    printed = capsys.readouterr().out
    results = json.loads((run / "evaluation" / "results.json").read_text())
    assert {"identity", "GICP", "Toy", "Toy + ICP"} <= results.keys()
    assert results["Toy"]["pairs"] == 6
    assert results["Toy"]["iso_r_deg_mean"] < results["identity"]["iso_r_deg_mean"]
    assert "Toy + ICP" in printed
    assert (run / "evaluation" / "report.html").read_text().count("<article") == 2


def test_it_is_exported_loaded_and_registers(run, tmp_path):
    assert cmig("export", run, tmp_path / "toy.npz") == 0
    network = load(tmp_path / "toy.npz")
    assert network.title == "Toy"
    target = np.random.default_rng(0).normal(size=(200, 3)) * [1, 0.6, 0.3]
    pose = register(target - [0.05, 0, 0], target, network).target_from_source
    np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-6)
    np.save(tmp_path / "cloud.npy", target)
    assert cmig("register", tmp_path / "cloud.npy", tmp_path / "cloud.npy", "--network", run, "--transform", tmp_path / "T.txt") == 0
    assert np.loadtxt(tmp_path / "T.txt").shape == (4, 4)


def test_a_table_of_it_is_a_command(declared, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cmig("experiments", "run", "table", "--source", "solids", "--runs", tmp_path / "runs") == 0
    rows = json.loads((tmp_path / "runs" / "full" / "table.json").read_text())["rows"]
    assert [row["label"] for row in rows] == ["16", "32"]
    assert all(row["runs"][0]["metrics"] for row in rows)


def test_bad_flags_of_it_are_one_line_of_error(declared, capsys):
    assert cmig("train", "toy", "--model.width", 0) == 2
    assert capsys.readouterr().err == "error: model.width = 0: expected at least 1\n"


def test_the_source_is_prepared(declared, tmp_path):
    flags = ["--data.source", "solids", "--data.shapes", 4, "--data.points", 64, "--views.layout", "axes", "--views.count", 6]
    assert cmig("prepare", *flags, "--out", tmp_path / "solids", "--workers", 1) == 0
    train, test = Shards(tmp_path / "solids", "train", verify="checksum"), Shards(tmp_path / "solids", "test")
    assert (len(train), len(test), train.categories) == (12, 6, CATEGORIES)


@pytest.mark.parametrize("marker", ["network", "data source"])
def test_the_page_shows_these_declarations(marker):
    shown = Path(__file__).read_text().split(f"# --- a {marker}\n")[1].split("\n# ---")[0].strip()
    assert shown in (Path(__file__).parents[1] / "docs" / "extending.md").read_text()
    assert len(shown.splitlines()) <= 60
