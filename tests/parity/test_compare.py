"""The live comparison; and that it would see a difference."""

import json

import numpy as np
import optax
import torch

from cmig_jax.parity import compare as comparing
from cmig_jax.parity.__main__ import main
from cmig_jax.parity.recorded import named_weights
from cmig_jax.parity.rows import Row, compare, table, worst_first
from cmig_jax.parity.sizes import SMALL
from cmig_jax.parity.twin_run import state_shapes

torch.set_num_threads(1)


def test_twin_and_network_agree_live(tmp_path, capsys):
    assert main(["compare", "--size", "small", "--json", str(tmp_path / "rows.json")]) == 0
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    groups = {row["key"].split("/")[0] for row in rows}
    assert groups == {"eval", "train", "gradient", "statistics", "adam"}
    trained = [name for name in state_shapes(SMALL) if not name.startswith(("significance_fc.", "MVCNN.fc.", "head."))]
    parameters = {name for name in trained if not name.endswith(("running_mean", "running_var", "num_batches_tracked"))}
    statistics = {name for name in trained if name.endswith(("running_mean", "running_var"))}
    assert {row["key"].removeprefix("gradient/") for row in rows if row["key"].startswith("gradient/")} == parameters
    assert {row["key"].removeprefix("statistics/") for row in rows if row["key"].startswith("statistics/")} == statistics
    assert {row["key"].removeprefix("adam/") for row in rows if row["key"].startswith("adam/")} == parameters | statistics
    assert {row["bound"] for row in rows if row["key"].startswith(("eval", "train"))} == {1e-8}
    said = capsys.readouterr().out
    assert "gradient" in said
    assert "FAIL" not in said


def test_given_weights_are_used(tmp_path, monkeypatch):
    state = named_weights(state_shapes(SMALL), 7)
    torch.save({"state_dict": {f"module.{name}": torch.tensor(value) for name, value in state.items()}}, tmp_path / "a.t7")
    seen = {}

    def stub(weights, sizes, inputs, margins, seed):
        seen.update(weights=weights, sizes=sizes, inputs=inputs)
        return [Row("eval/R", 0.0, 0.0, 1e-8)]

    monkeypatch.setattr("cmig_jax.parity.__main__.compare_live", stub)
    arguments = ["compare", "--weights", str(tmp_path / "a.t7"), "--size", "small", "--pairs", "3", "--points", "50", "--keypoints", "20"]
    assert main(arguments) == 0
    assert all(np.array_equal(seen["weights"][name], state[name]) for name in state)
    assert (seen["sizes"].iterations, seen["sizes"].dim, seen["sizes"].keypoints) == (2, 32, 20)
    assert seen["inputs"].src.shape == (3, 3, 50)
    monkeypatch.setattr("cmig_jax.parity.__main__.compare_live", lambda *_: [Row("eval/R", 1.0, 1.0, 1e-8)])
    assert main(["compare"]) == 1


def test_decoupled_decay_would_be_seen():
    """Three steps of AdamW differ from Adam's with the decay in the gradient by more than the bound."""
    rng = np.random.default_rng(0)
    start, gradients = rng.standard_normal(50), rng.standard_normal((3, 50))
    weights = torch.nn.Parameter(torch.tensor(start))
    adam = torch.optim.Adam([weights], lr=1e-4, weight_decay=1e-3)
    for gradient in gradients:
        weights.grad = torch.tensor(gradient)
        adam.step()
    other, moments = start.astype(np.float32), None
    decoupled = optax.adamw(1e-4, weight_decay=1e-3)
    moments = decoupled.init(other)
    for gradient in gradients.astype(np.float32):
        updates, moments = decoupled.update(gradient, moments, other)
        other = optax.apply_updates(other, updates)
    assert not compare("adam", np.asarray(other), weights.detach().numpy(), 1e-8).holds


def test_rows():
    row = compare("a", np.array([1.0, 2.0]), np.array([1.0, 4.0]), 1e-8)
    assert (row.absolute, row.relative, row.holds) == (2, 0.5, False)
    assert compare("a", np.array([1e-3, 4.0]), np.array([2e-3, 4.0]), 1e-3).holds
    assert not compare("a", np.array([1e-3, 4.0]), np.array([2e-3, 4.0]), 1e-3, elementwise=True).holds
    assert compare("a", np.array(0.0), np.array(0.0), 1e-8).relative == 0
    assert compare("a", np.array(1e-16), np.array(3e-16), 1e-6, floor=1e-9).holds
    assert not compare("a", np.array(1e-16), np.array(3e-16), 1e-6).holds
    assert not compare("a", np.array([np.nan]), np.array([1.0]), 1e-8).holds
    assert not compare("a", None, np.array([1.0]), 1e-8).holds
    assert compare("a", np.zeros(2), np.ones(3), 1e-8).note == "shape (2,), recorded (3,)"
    rows = [Row("fine", 0, 1e-9, 1e-8), Row("shown", 9, 9, None), Row("bad", 0, 1e-5, 1e-6), Row("nan", 0, float("nan"), 1e-6)]
    assert [row.key for row in worst_first(rows)] == ["nan", "bad", "fine", "shown"]
    assert "FAILS" in table(rows)
    assert comparing.summary(rows).count("1 FAIL") == 2
