"""PyTorch files, run folders, and the conversion between them."""

import os
import pickle
from dataclasses import replace

import jax
import numpy as np
import pytest
import safetensors.torch
import torch

from cmig_jax.inference.load import load
from cmig_jax.parity.cmignet_layout import layout, small
from cmig_jax.parity.convert import convert
from cmig_jax.parity.torch_files import read_torch, write_torch
from cmig_jax.parity.weights import named_weights

STATE = {name: np.asarray(value, np.float32 if value.ndim else np.int64) for name, value in named_weights(layout(small()), 0).items()}


def tensors(state=STATE):
    return {name: torch.tensor(value) for name, value in state.items()}


def same(a, b) -> bool:
    return list(a) == list(b) and all(a[k].dtype == b[k].dtype and np.array_equal(a[k], b[k]) for k in a)


@pytest.mark.parametrize("suffix", [".t7", ".pt", ".pth", ".safetensors"])
def test_files_are_read_and_written(tmp_path, suffix):
    write_torch(tmp_path / f"a{suffix}", STATE)
    read = read_torch(tmp_path / f"a{suffix}")
    assert {name: value.tobytes() for name, value in read.items()} == {name: value.tobytes() for name, value in STATE.items()}


@pytest.mark.parametrize(
    "wrap",
    [
        lambda state: {f"module.{name}": value for name, value in state.items()},
        lambda state: {"state_dict": state, "epoch": 7},
        lambda state: {"model": {f"module.{name}": value for name, value in state.items()}, "optimizer": {"lr": 1e-4}},
        lambda state: {"epoch": 1, "model_state_dict": {f"module.module.{name}": value for name, value in state.items()}},
    ],
)
def test_wrappings_are_taken_off(tmp_path, wrap):
    torch.save(wrap(tensors()), tmp_path / "a.pth")
    assert same(read_torch(tmp_path / "a.pth"), STATE)


def test_old_format_and_brain_floats(tmp_path):
    old = {"a": torch.rand(3), "b": torch.rand(2).bfloat16()}
    torch.save(old, tmp_path / "a.t7", _use_new_zipfile_serialization=False)
    read = read_torch(tmp_path / "a.t7")
    assert np.array_equal(read["a"], old["a"].numpy())
    assert np.array_equal(read["b"], old["b"].float().numpy())


class Malicious:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("save", [torch.save, lambda value, path: path.write_bytes(pickle.dumps(value))])
def test_a_pickle_that_runs_code_is_refused(tmp_path, save, main):
    save({"h3.6.bias": Malicious(tmp_path / "ran")}, tmp_path / "a.pt")
    with pytest.raises(ValueError, match=r"a\.pt: refused"):
        read_torch(tmp_path / "a.pt")
    done = main("parity", "convert", tmp_path / "a.pt", tmp_path / "run")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert not (tmp_path / "ran").exists()
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_damaged_files_are_refused(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_torch(path, STATE)
    whole = path.read_bytes()
    for part in (b"", b"not weights", whole[: len(whole) // 2], whole[:100]):
        path.write_bytes(part)
        with pytest.raises(ValueError, match=str(path)):
            read_torch(path)
    with pytest.raises(ValueError, match="absent"):
        read_torch(tmp_path / f"absent{suffix}")


@pytest.mark.parametrize("content", [{"a": 1, "b": torch.zeros(2)}, torch.zeros(3), {}, [torch.zeros(2)]])
def test_other_things_than_a_state_are_refused(tmp_path, content):
    torch.save(content, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="expected a dict of tensors"):
        read_torch(tmp_path / "a.pt")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_through_a_run_folder_and_back(tmp_path, dtype, main):
    state = {name: value.astype(dtype) if value.ndim else value + 12 for name, value in named_weights(layout(small()), 3).items()}
    write_torch(tmp_path / "in.t7", state)
    done = main("parity", "convert", tmp_path / "in.t7", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    for unused in ("significance_fc.conv.0.conv.weight", "MVCNN.fc.0.bias", "head.reflect"):
        assert unused in done.stdout
    assert main("parity", "convert", tmp_path / "run", tmp_path / "out.safetensors").returncode == 0
    assert main("parity", "convert", tmp_path / "out.safetensors", tmp_path / "out.pt").returncode == 0
    assert same(read_torch(tmp_path / "out.pt"), state)
    back = safetensors.torch.load_file(tmp_path / "out.safetensors")
    assert all(np.array_equal(back[name].numpy(), state[name]) for name in state)


def test_a_converted_run_loads(tmp_path):
    write_torch(tmp_path / "in.pth", STATE)
    convert(tmp_path / "in.pth", tmp_path / "run")
    network = load(tmp_path / "run")
    hidden = replace(small(), points=replace(small().points, k=20), fusion=replace(small().fusion, heads=4))
    assert network.config.model == replace(hidden, keypoints=replace(hidden.keypoints, count=256))  # they leave no trace in a state
    assert network.step == 0
    kernel = jax.device_get(network.variables)["params"]["transformer"]["decoder_cross"]["value"]["kernel"]
    assert np.array_equal(kernel, STATE["attn.model.decoder.layers.0.src_attn.linears.2.weight"].T)


def test_what_training_changed_goes_back_changed(tmp_path):
    exact = {name: value.astype(np.float64) if value.ndim else value for name, value in named_weights(layout(small()), 3).items()}
    write_torch(tmp_path / "in.pt", exact)
    convert(tmp_path / "in.pt", tmp_path / "run")
    other = {name: value + 1 if name == "h3.0.bias" else value for name, value in exact.items()}
    np.savez(tmp_path / "run" / "pytorch_only.npz", **other)
    convert(tmp_path / "run", tmp_path / "out.pt")
    back = read_torch(tmp_path / "out.pt")
    assert np.array_equal(back["h3.0.bias"], exact["h3.0.bias"].astype(np.float32))
    assert np.array_equal(back["h3.2.bias"], exact["h3.2.bias"])


def test_bad_requests_are_one_line(tmp_path, main):
    write_torch(tmp_path / "in.pt", STATE)
    write_torch(tmp_path / "part.pt", {name: value for name, value in STATE.items() if name != "h3.6.bias"})
    (tmp_path / "there").mkdir()
    for source, target, reason in (
        ("in.pt", "there", "exists"),
        ("part.pt", "run", "missing h3.6.bias"),
        ("there", "out.pt", "config.json"),
        ("absent.pt", "run", "absent.pt"),
        ("there", "other", "expected a PyTorch file"),
    ):
        done = main("parity", "convert", tmp_path / source, tmp_path / target)
        assert (done.returncode, done.stderr.count("\n")) == (2, 1)
        assert reason in done.stderr
    assert not (tmp_path / "run").exists()
