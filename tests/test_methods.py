"""The learned methods as their user meets them: trained, evaluated, exported, loaded, used by `register`, and behind MaskNet."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from cmig_jax import cli, load, register
from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.prepare import prepare
from cmig_jax.experiments.plan import changes, command_line
from cmig_jax.inference.load import Network
from cmig_jax.inference.masked import behind_mask
from configs import PRESETS
from configs.catalogue import catalogue
from configs.methods import METHODS
from configs.scale import at_toy_scale

QUICK = "masknet"
"""The one that is always tested, since it stands in front of another below."""
NAMES = [name for name in METHODS if not name.endswith("-cpu")]


def cmig(*arguments: object) -> None:
    assert cli.main([str(argument) for argument in arguments], catalogue) == 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with 160 generated objects, prepared, that trainings and evaluations run in."""
    path = tmp_path_factory.mktemp("methods")
    prepare(DataConfig(source="shapes", shapes=4), ViewsConfig(of="both"), path / "prepared", workers=1, progress=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        yield path


def trained(name: str, folder: Path) -> Path:
    """Train a preset at toy scale; return its run folder."""
    preset = PRESETS[name]()
    flags = changes(preset, at_toy_scale(preset)) | {
        "data.source": "shapes",
        "data.shapes": 4,
        "data.prepared": "prepared",
        "data.exclude": (),
    }
    if not (folder / "runs" / name).exists():
        cmig("train", name, *command_line(flags), "--devices", 1)
    return folder / "runs" / name


def rounded(network: Network) -> Network:
    """Round the parameters as a weights file does."""
    half = jax.tree.map(lambda x: np.asarray(x, np.float16).astype(np.float32), network.variables["params"])
    return dataclasses.replace(network, variables={**network.variables, "params": half})


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name == QUICK else pytest.mark.slow) for name in NAMES])
def test_a_method_goes_all_the_way(name, folder, capsys):
    run = trained(name, folder)
    cmig("evaluate", run, "--limit", 3, "--batch", 3, "--report", "--report-pairs", 1)
    network = load(run)
    assert f"{network.title} + ICP" in capsys.readouterr().out
    assert (run / "evaluation" / "report.html").stat().st_size > 0
    cmig("export", run, folder / f"{name}.npz")
    same = load(folder / f"{name}.npz")
    rng = np.random.default_rng(0)
    source = rng.normal(size=(90, 3)) * (1, 0.6, 0.3)
    target = source[rng.permutation(90)] + (0.1, -0.2, 0.3)
    found = register(source, target, network=same, refine=False)
    np.testing.assert_array_equal(found.matrix, register(source, target, network=rounded(network), refine=False).matrix)


def test_a_network_behind_masknet(folder, capsys):
    mask, run = trained("masknet", folder), trained("pcrnet", folder)
    cmig("evaluate", run, "--limit", 2, "--batch", 2, "--mask", mask, "--out", "masked")
    assert "MaskNet, then PCRNet" in capsys.readouterr().out
    with pytest.raises(ValueError, match="mask: a network pcrnet, expected masknet"):
        behind_mask(load(run), load(run))
