"""The evaluation loop: what it writes, and that an interruption changes nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cmig_jax.baselines import classical
from cmig_jax.config import DataConfig
from cmig_jax.data.prepare import prepare
from cmig_jax.devices import device_mesh
from cmig_jax.evaluation.engine import ERRORS, METADATA, PARTIAL, RESULTS, evaluate, one_by_one
from cmig_jax.evaluation.pairs import pairs_to_test
from cmig_jax.training.checkpoint import Checkpoints, write_config
from cmig_jax.training.loop import training_data
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import build, create_state
from cmig_jax.transform import RigidTransform

identity, icp_tuned = (classical(DataConfig())[name].register for name in ("identity", "ICP (tuned)"))


def make_pair(i: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(i)
    points = rng.normal(size=(100, 3)) * [1.0, 0.6, 0.3]
    R, t = Rotation.from_euler("xyz", rng.uniform(0, 30, 3), degrees=True).as_matrix(), rng.uniform(-0.2, 0.2, 3)
    return {
        "source": points,
        "target": (points @ R.T + t)[:90],
        "R": R,
        "t": t,
        "object": points,
        "index": np.array(i),
        "label": np.array(i % 3),
    }


PAIRS = [make_pair(i) for i in range(7)]
SETTINGS = {"command": "python evaluate.py", "config": {"seed": 0}, "chunk": 3, "progress": False}


def truth(pairs):
    return RigidTransform(R=np.stack([pair["R"] for pair in pairs]), t=np.stack([pair["t"] for pair in pairs]))


class Counting:
    """A method that counts its calls, and is interrupted at one of them."""

    def __init__(self, method, interrupt_at=None):
        self.method, self.calls, self.interrupt_at = method, 0, interrupt_at

    def __call__(self, pairs):
        self.calls += 1
        if self.calls == self.interrupt_at:
            raise KeyboardInterrupt
        return self.method(pairs)


def without_time(results):
    return {name: {k: v for k, v in row.items() if k != "seconds_per_pair"} for name, row in results.items() if name not in METADATA}


def test_writes_what_it_returns(tmp_path):
    results = evaluate(PAIRS, {"identity": one_by_one(identity), "truth": truth}, tmp_path / "run", **SETTINGS)
    assert json.loads((tmp_path / "run" / RESULTS).read_text()) == results
    assert list(results) == ["identity", "truth", "command", "config", "versions"]
    assert results["truth"]["rmse_r_deg"] == pytest.approx(0, abs=1e-5)
    assert results["truth"]["recall"] == results["truth"]["recall_closest_point"] == 1
    assert results["truth"]["chamfer"] == pytest.approx(0, abs=1e-20)
    assert results["identity"]["chamfer"] > 0.001
    assert results["identity"]["rmse_r_deg"] > 5
    assert results["identity"]["pairs"] == 7
    assert results["identity"]["seconds_per_pair"] > 0
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [ERRORS, RESULTS]
    with np.load(tmp_path / "run" / ERRORS) as errors:
        np.testing.assert_array_equal(errors["index"], range(7))
        np.testing.assert_array_equal(errors["label"], np.arange(7) % 3)
        assert errors["identity/R"].shape == (7, 3, 3)
        for key in ("closest_point", "chamfer"):
            assert np.mean(errors[f"identity/{key}"]) == pytest.approx(results["identity"][key])
        np.testing.assert_allclose(errors["angle_deg"], errors["identity/iso_r_deg"])
        np.testing.assert_allclose(errors["overlap"], 0.9, atol=0.05)  # of 100 points 90 are in both


def test_an_interrupted_run_continues_with_the_same_results(tmp_path):
    expected = evaluate(PAIRS, {"icp": one_by_one(icp_tuned), "truth": truth}, tmp_path / "whole", **SETTINGS)
    first = Counting(one_by_one(icp_tuned), interrupt_at=3)
    with pytest.raises(KeyboardInterrupt):
        evaluate(PAIRS, {"icp": first, "truth": truth}, tmp_path / "cut", **SETTINGS)
    assert not (tmp_path / "cut" / RESULTS).exists()
    second = Counting(one_by_one(icp_tuned))
    results = evaluate((make_pair(i) for i in range(7)), {"icp": second, "truth": truth}, tmp_path / "cut", **SETTINGS)
    assert second.calls == 1 + 2  # the warm-up and the two chunks that were missing
    assert without_time(results) == without_time(expected)
    assert not (tmp_path / "cut" / PARTIAL).exists()


@pytest.mark.parametrize("change", ["config", "pairs"])
def test_finished_chunks_of_other_settings_are_not_used(tmp_path, change):
    failing = Counting(truth, interrupt_at=5)
    with pytest.raises(KeyboardInterrupt):
        evaluate(PAIRS, {"identity": one_by_one(identity), "other": failing}, tmp_path, **SETTINGS | {"chunk": 2})
    pairs = [pair | {"source": pair["source"] + 0.1} for pair in PAIRS] if change == "pairs" else PAIRS
    again = Counting(one_by_one(identity))
    evaluate(pairs, {"identity": again}, tmp_path, **SETTINGS | {"chunk": 2} | ({"config": {"seed": 1}} if change == "config" else {}))
    assert again.calls == 1 + 4


def test_a_damaged_chunk_is_computed_again(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        evaluate(PAIRS, {"truth": Counting(truth, interrupt_at=4)}, tmp_path, **SETTINGS)
    for path in (tmp_path / PARTIAL).iterdir():
        path.write_bytes(path.read_bytes()[:100])
    assert evaluate(PAIRS, {"truth": truth}, tmp_path, **SETTINGS)["truth"]["recall"] == 1


def test_pairs_without_an_object_have_no_closest_point_and_may_have_an_overlap(tmp_path):
    pairs = [{key: pair[key] for key in ("source", "target", "R", "t")} | {"overlap": np.float32(0.5)} for pair in PAIRS]
    results = evaluate(pairs, {"truth": truth}, tmp_path, **SETTINGS)
    assert not {"closest_point", "recall_closest_point", "chamfer"} & set(results["truth"])
    with np.load(tmp_path / ERRORS) as errors:
        np.testing.assert_array_equal(errors["index"], range(7))
        assert np.isnan(errors["truth/closest_point"]).all()
        np.testing.assert_array_equal(errors["overlap"], 0.5)


def test_a_broken_pose_names_the_method_and_the_pair(tmp_path):
    def broken(pairs):
        poses = truth(pairs)
        poses.t[[int(pair["index"]) == 4 for pair in pairs]] = np.nan
        return poses

    with pytest.raises(ValueError, match=r"broken, pair 4"):
        evaluate(PAIRS, {"broken": broken}, tmp_path, **SETTINGS)
    assert not (tmp_path / RESULTS).exists()


@pytest.mark.parametrize(
    ("pairs", "methods", "message"),
    [
        ([], {"truth": truth}, "at least one"),
        (PAIRS, {}, "at least one"),
        (PAIRS, {"config": truth}, "no method named"),
        ([{"source": np.zeros((3, 3))}], {"truth": truth}, "pair 0: target, R, t missing"),
        (PAIRS, {"short": lambda pairs: truth(pairs[:2])}, r"translations of shape \(2, 3\) for 3 pairs"),
    ],
)
def test_bad_input_is_refused(tmp_path, pairs, methods, message):
    with pytest.raises(ValueError, match=message):
        evaluate(pairs, methods, tmp_path, **SETTINGS)
    assert not (tmp_path / RESULTS).exists()


def test_excluded_categories_are_not_tested(tiny):
    config = replace(tiny, data=replace(tiny.data, exclude=("bowl", "lamp")))
    assert {int(pair["label"]) for pair in pairs_to_test(config)} == {0, 2}
    with pytest.raises(ValueError, match=r"data\.exclude: vase: expected names of categories, which are bottle, bowl, chair, lamp"):
        pairs_to_test(replace(tiny, data=replace(tiny.data, exclude=("vase",))))
    with pytest.raises(ValueError, match=r"data\.test_categories=first-half without data\.exclude=\('bottle', 'bowl'\), found none"):
        pairs_to_test(replace(tiny, data=replace(tiny.data, test_categories="first-half", exclude=("bottle", "bowl"))))


def test_validation_pairs_are_those_that_the_training_holds_out(tiny):
    held, trained = pairs_to_test(replace(tiny, data=replace(tiny.data, tested="validation"))), training_data(tiny)
    assert list(held.names) == list(trained.validation.names)
    assert not set(held.names) & set(trained.train.names)
    np.testing.assert_array_equal(held[0]["target"], trained.validation[0]["target"])


def test_half_of_the_frames_are_turned_in_training_alone(tiny):
    half, plain = (replace(tiny, data=replace(tiny.data, frame=frame)) for frame in ("half", "object"))
    for pairs in (pairs_to_test, lambda config: training_data(config).validation):
        assert all(np.array_equal(one["R"], other["R"]) for one, other in zip(pairs(half), pairs(plain), strict=True))
    any_frame = pairs_to_test(replace(tiny, data=replace(tiny.data, frame="any")))
    assert not any(np.array_equal(one["R"], other["R"]) for one, other in zip(any_frame, pairs_to_test(plain), strict=True))


def test_rpmnet_s_protocol_keeps_70_percent_of_independent_samplings(tiny, tmp_path):
    data = replace(tiny.data, points=30, sampling="twice", crop="half-space", keep=0.7, prepared=str(tmp_path))
    config = replace(tiny, data=data)
    prepare(config.data, config.views, tmp_path, workers=1, progress=False)
    results = evaluate(pairs_to_test(config), {"truth": truth}, tmp_path / "run", **SETTINGS)
    assert pairs_to_test(config)[0]["source"].shape == (21, 3)
    assert results["truth"]["iso_r_deg_mean"] == pytest.approx(0, abs=1e-3)
    assert results["truth"]["chamfer"] == pytest.approx(6 * 0.01**2, rel=0.2)  # the noise of both clouds, in three coordinates


@pytest.fixture
def scans(tmp_path):
    """Three range scans of a thing, from places 20 degrees apart."""
    thing, lines = np.random.default_rng(0).normal(size=(400, 3)) * [1, 0.6, 0.3], []
    for k in range(3):
        turn = Rotation.from_euler("y", 20 * k, degrees=True)
        trimesh.PointCloud(thing[50 * k : 300 + 50 * k] @ turn.as_matrix().T).export(tmp_path / f"{k}.ply")
        lines.append(f"bmesh {k}.ply 0 0 0 {' '.join(map(str, turn.as_quat()))}")
    (tmp_path / "thing.conf").write_text("\n".join(lines))
    return tmp_path


@pytest.fixture
def untrained(tiny, tmp_path):
    """The run folder of a network that has learnt nothing."""
    run = tmp_path / "untrained"
    write_config(run, tiny)
    checkpoints = Checkpoints(run)
    checkpoints.save(0, create_state(build(tiny), optimizer(tiny.optim, 1), tiny, device_mesh(1, 1)), {}, None)
    checkpoints.close()
    return run


def test_a_run_is_evaluated_on_recorded_pairs_and_not_trained_on_them(main, untrained, scans, tmp_path):
    flags = ("--data.source", "stanford-scans", "--data.root", scans, "--data.prepared", tmp_path / "prepared")
    done = main("evaluate", untrained, *flags, "--limit", 4, "--batch", 4, "--out", "scans")
    assert done.returncode == 0, done.stderr
    results = json.loads((untrained / "scans" / RESULTS).read_text())
    assert results["CMIGNet"]["pairs"] == 4
    assert "chamfer" not in results["identity"]
    with np.load(untrained / "scans" / ERRORS) as errors:
        assert set(errors["angle_deg"].round(3)) == {20, 40}
        np.testing.assert_allclose(errors["angle_deg"], errors["identity/iso_r_deg"])
        assert (errors["overlap"] > 0.6).all()
    refused = main("train", "quickstart", *flags[:4], "--name", "never", "--runs", tmp_path)
    assert refused.returncode == 2
    assert "data.source = stanford-scans has no objects to train on: expected another" in refused.stderr
    assert not (tmp_path / "never").exists()


def test_keypoints_of_training_do_not_limit_a_test_that_has_its_own(tiny):
    def with_keypoints(**changes):
        return replace(tiny, model=replace(tiny.model, keypoints=replace(tiny.model.keypoints, **changes)))

    assert len(pairs_to_test(with_keypoints(count=40, test_count=20))) == 8
    with pytest.raises(ValueError, match=r"data\.points = 48 leaves 36 points after the crop: expected at least 40"):
        pairs_to_test(with_keypoints(count=40))
