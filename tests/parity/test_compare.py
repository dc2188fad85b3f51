"""The live comparison, and that it would see a difference; rows and their table."""

import json
from dataclasses import replace

import numpy as np
import optax
import pytest
import torch

from cmig_jax.parity.cmignet_layout import UNUSED, layout, small
from cmig_jax.parity.rows import Row, compare, summary, table, used, write_json
from cmig_jax.parity.weights import COUNTER, RUNNING, named_weights

torch.set_num_threads(1)


@pytest.mark.parametrize("kernels", ["plain", pytest.param("fast", marks=pytest.mark.slow)])
def test_twin_and_network_agree_live(tmp_path, main, kernels):
    done = main("parity", "compare", "--iterations", 1, "--kernels", kernels, "--json", tmp_path / "rows.json")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    by_group = {}
    for row in rows:
        group, _, name = row["key"].partition("/")
        by_group.setdefault(group, set()).add(name)
    flags = replace(small(), matching=replace(small().matching, iterations=1))
    trained = {tensor.name for tensor in layout(flags) if not tensor.name.startswith(UNUSED) and not tensor.name.endswith(COUNTER)}
    statistics = {name for name in trained if name.endswith(RUNNING)}
    assert set(by_group) == {"eval", "train", "gradient", "statistics", "adam"}
    assert by_group["gradient"] == trained - statistics
    assert by_group["statistics"] == statistics
    assert by_group["adam"] == trained
    assert {"loss", "loss_terms", "R", "t", "it0/match_F", "attn_src_views_0"} <= by_group["train"]
    assert {row["bound"] for row in rows if row["key"].startswith(("eval", "train"))} == {1e-8}
    assert not any(row["tie"] for row in rows)
    assert "gradient" in done.stdout
    assert "FAIL" not in done.stdout


def test_given_weights_are_used(tmp_path, monkeypatch, main):
    state = named_weights(layout(small()), 7)
    torch.save({"state_dict": {f"module.{name}": torch.tensor(value) for name, value in state.items()}}, tmp_path / "a.t7")
    seen = {}

    def stub(weights, flags, inputs, seed, kernels):
        seen.update(weights=weights, flags=flags, inputs=inputs, seed=seed, kernels=kernels)
        return [Row("eval/R", 0.0, 0.0, 1e-8)]

    monkeypatch.setattr("cmig_jax.parity.cmignet_compare.compare_live", stub)
    sizes = ("--pairs", 3, "--points", 50, "--keypoints", 20, "--margins", 5, 9)
    assert main("parity", "compare", "--weights", tmp_path / "a.t7", *sizes).returncode == 0
    assert all(np.array_equal(seen["weights"][name], state[name]) for name in state)
    flags = seen["flags"]
    assert (flags.matching.iterations, flags.points.dim, flags.keypoints.count) == (2, 32, 20)
    assert (flags.loss.overlap, flags.loss.margins) == (True, (5, 9))
    assert seen["inputs"]["src"].shape == (3, 3, 50)
    assert main("parity", "compare", "--size", "paper", "--iterations", 5, "--seed", 4, "--kernels", "plain").returncode == 0
    assert (seen["flags"].matching.iterations, seen["flags"].points.dim, seen["flags"].keypoints.count) == (5, 512, 96)
    assert (seen["inputs"]["src"].shape, seen["inputs"]["views"].shape) == ((2, 3, 320), (2, 2, 3, 64, 64))
    assert (seen["seed"], seen["kernels"]) == (4, "plain")
    monkeypatch.setattr("cmig_jax.parity.cmignet_compare.compare_live", lambda *_: [Row("eval/R", 1.0, 1.0, 1e-8)])
    assert main("parity", "compare").returncode == 1


def test_decoupled_decay_would_be_seen():
    """Three steps of AdamW differ from Adam's with the decay in the gradient by more than the bound."""
    rng = np.random.default_rng(0)
    start, gradients = rng.standard_normal(50), rng.standard_normal((3, 50))
    weights = torch.nn.Parameter(torch.tensor(start))
    adam = torch.optim.Adam([weights], lr=1e-4, weight_decay=1e-3)
    for gradient in gradients:
        weights.grad = torch.tensor(gradient)
        adam.step()
    other, decoupled = start.astype(np.float32), optax.adamw(1e-4, weight_decay=1e-3)
    moments = decoupled.init(other)
    for gradient in gradients.astype(np.float32):
        updates, moments = decoupled.update(gradient, moments, other)
        other = optax.apply_updates(other, updates)
    assert not compare("adam", np.asarray(other), weights.detach().numpy(), 1e-8).holds


def test_rows(tmp_path):
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
    rows = [Row("fine", 0, 1e-9, 1e-8), Row("tie", 9, 9, 1e-8, "why", True), Row("bad", 0, 1e-5, 1e-6), Row("nan", 0, float("nan"), 1e-6)]
    assert [row.key for row in sorted(rows, key=used, reverse=True)] == ["nan", "bad", "fine", "tie"]
    lines = table(rows).splitlines()
    assert [line.split()[4:] for line in lines[1:]] == [[], ["TIE", "why"], ["FAILS"], ["FAILS"]]
    assert "2 FAIL, 1 by a TIE" in summary(rows, lambda _: "all")
    assert summary(rows, lambda key: key).count("1 FAIL") == 2
    write_json(tmp_path / "rows.json", {"seed": 3}, rows)
    written = json.loads((tmp_path / "rows.json").read_text())
    assert (written["seed"], written["holds"]) == (3, False)
    assert [(row["relative"], row["holds"]) for row in written["rows"]] == [(1e-9, True), (9, True), (1e-5, False), (None, False)]
