"""Weights files: what is written is read, what does not fit is named, and the packaged network registers."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax import Config, load, register
from cmig_jax.data.raw import RawObject
from cmig_jax.data.sample import object_points
from cmig_jax.data.shapes import make_object
from cmig_jax.export import main
from cmig_jax.weights import check_variables, read_weights, write_weights

VARIABLES = {
    "params": {"layer": {"kernel": jnp.arange(6.0).reshape(2, 3)}},
    "batch_stats": {"norm": {"mean": jnp.array([1e-6, 1e6])}},
}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    write_weights(tmp_path / "w.npz", Config(name="mine"), 7, VARIABLES)
    config, step, variables = read_weights(tmp_path / "w.npz")
    assert (config, step) == (Config(name="mine"), 7)
    jax.tree.map(np.testing.assert_array_equal, variables, VARIABLES)
    assert [path.name for path in tmp_path.iterdir()] == ["w.npz"]


@pytest.mark.parametrize("content", [b"", b"not an archive", None])
def test_a_damaged_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "w.npz"
    write_weights(path, Config(), 0, VARIABLES)
    path.write_bytes(path.read_bytes()[:-40] if content is None else content)
    with pytest.raises(ValueError, match=r"w\.npz: expected a weights file"):
        load(path)


def test_variables_of_another_network_are_listed() -> None:
    like = {"params": {"layer": {"kernel": np.zeros((3, 3)), "bias": np.zeros(3)}}, "batch_stats": {}}
    with pytest.raises(ValueError, match="missing params/layer/bias, surplus batch_stats/norm/mean, params/layer/kernel") as error:
        check_variables(VARIABLES, like, "w.npz")
    assert str(error.value).startswith("w.npz")


@pytest.mark.parametrize("side", [1, -1])
def test_the_packaged_network_brings_an_unseen_object_closer(side: int) -> None:
    cloud = object_points(RawObject("axe", 39, "test", lambda: make_object(39, np.random.default_rng(3))), 400, np.random.default_rng(0))
    R, t = Rotation.from_euler("zyx", side * np.array([30, 20, 10]), degrees=True).as_matrix(), np.array([3.0, -2.0, 1.0])
    found = register(5 * cloud[:300], 5 * cloud[80:] @ R.T + t)
    error = np.linalg.norm(5 * cloud @ (np.asarray(found.R) - R).T + found.t - t, axis=1).mean()
    start = np.linalg.norm(5 * cloud @ (np.eye(3) - R).T - t, axis=1).mean()
    assert error < 0.2 * start


def test_export_names_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 2
    assert main([str(tmp_path / "none"), str(tmp_path / "w.npz")]) == 2
    assert str(tmp_path / "none") in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
