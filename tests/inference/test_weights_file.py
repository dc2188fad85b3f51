"""Weights files: what is written is read, what does not fit is named, and the packaged network registers."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax import load, register
from cmig_jax.data.generated import make_object
from cmig_jax.data.sample import sample_surface
from cmig_jax.inference import weights_file
from cmig_jax.inference.weights_file import PRETRAINED, check_variables, read_weights, write_weights
from configs import PRESETS

CONFIG = PRESETS["own-clouds"]()
VARIABLES = {
    "params": {"layer": {"kernel": jnp.arange(6.0).reshape(2, 3)}},
    "batch_stats": {"norm": {"mean": jnp.array([1e-6, 1e6])}},
}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_weights(tmp_path / "w.npz", CONFIG, 7, VARIABLES)
    config, step, variables = read_weights(tmp_path / "w.npz")
    assert (config, step) == (CONFIG, 7)
    jax.tree.map(np.testing.assert_array_equal, variables, VARIABLES)
    assert [path.name for path in tmp_path.iterdir()] == ["w.npz"]


def test_a_parameter_too_large_for_half_precision_is_named(tmp_path: Path) -> None:
    large = VARIABLES | {"params": {"layer": {"kernel": jnp.array([1.0, -1e5])}}}
    with pytest.raises(ValueError, match=r"params/layer/kernel: its largest value is 100000; half precision holds 65504"):
        write_weights(tmp_path / "w.npz", CONFIG, 7, large)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", [b"", b"not an archive", None])
def test_a_damaged_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "w.npz"
    write_weights(path, CONFIG, 0, VARIABLES)
    path.write_bytes(path.read_bytes()[:-40] if content is None else content)
    with pytest.raises(ValueError, match=r"w\.npz: expected a weights file"):
        load(path)


def test_no_damaged_byte_is_more_than_a_named_error(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    write_weights(path, CONFIG, 0, VARIABLES)
    content, messages = path.read_bytes(), []
    for place in range(0, len(content), 5):
        damaged = bytearray(content)
        damaged[place] ^= 255
        path.write_bytes(damaged)
        try:
            read_weights(path)
        except ValueError as error:
            messages.append(str(error))
    assert len(messages) > 100
    assert all(message.startswith(f"{path}: expected a weights file") for message in messages)


def test_variables_of_another_network_are_listed() -> None:
    like = {"params": {"layer": {"kernel": np.zeros((3, 3)), "bias": np.zeros(3)}}, "batch_stats": {}}
    with pytest.raises(ValueError, match="missing params/layer/bias, surplus batch_stats/norm/mean, params/layer/kernel") as error:
        check_variables(VARIABLES, like, "w.npz")
    assert str(error.value).startswith("w.npz")


@pytest.mark.parametrize("side", [1, -1])
def test_the_packaged_network_brings_an_unseen_object_closer(side: int) -> None:
    cloud = sample_surface(make_object(39, np.random.default_rng(3)), 400, np.random.default_rng(0))
    R, t = Rotation.from_euler("zyx", side * np.array([30, 20, 10]), degrees=True).as_matrix(), np.array([3.0, -2.0, 1.0])
    found = register(5 * cloud[:300], 5 * cloud[80:] @ R.T + t, load(), refine=False).target_from_source
    error = np.linalg.norm(5 * cloud @ (np.asarray(found.R) - R).T + found.t - t, axis=1).mean()
    start = np.linalg.norm(5 * cloud @ (np.eye(3) - R).T - t, axis=1).mean()
    assert error < 0.2 * start


def test_the_packaged_weights_are_of_the_present_layout() -> None:
    """An older file would be read too, through `models.networks`; the packaged one needs no such help."""
    with np.load(PRETRAINED) as file:
        assert json.loads(str(file["config.json"]))["network"] == read_weights(PRETRAINED)[0].model.network


def test_another_file_in_the_place_of_the_packaged_one_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, step, variables = read_weights(PRETRAINED)
    write_weights(tmp_path / "own-clouds.npz", config, step + 1, variables)
    assert read_weights(tmp_path / "own-clouds.npz")[1] == step + 1
    monkeypatch.setattr(weights_file, "PRETRAINED", tmp_path / "own-clouds.npz")
    with pytest.raises(ValueError, match=r"own-clouds\.npz: SHA-256 .*expected [0-9a-f]{64}, the file that comes.*install it again"):
        read_weights(tmp_path / "own-clouds.npz")


def test_export_names_what_is_wrong(main, tmp_path: Path) -> None:
    assert main("export", tmp_path).returncode == 2
    assert f"{tmp_path / 'w.txt'}: expected a file name that ends in .npz" in main("export", tmp_path, tmp_path / "w.txt").stderr
    assert f"{tmp_path / 'none'}: expected a run folder" in main("export", tmp_path / "none", tmp_path / "w.npz").stderr
    assert not list(tmp_path.iterdir())
