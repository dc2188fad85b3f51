"""The calibration: pairs are what they are said to be, both models are found again, and an interrupted search continues."""

import itertools
import json

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from cmig_jax.data.raw import RawObject
from cmig_jax.registration import calibrate
from cmig_jax.registration.calibrate import Best, Command, best_of, fit_choice, fit_confidence, is_right, main, report
from cmig_jax.registration.drawn import BOUND_DEG, draw, visible
from cmig_jax.transform import RigidTransform


def body(name: str, size: tuple[float, float, float]) -> RawObject:
    return RawObject(name, 0, "train", lambda: trimesh.creation.box(size))


BODIES = [body("plank", (2, 1, 0.2)), body("post", (0.3, 0.3, 2)), body("brick", (2, 1, 0.7))]


def drawn(kind: str, number: int = 1):
    found = (draw(BODIES, i % 3, np.random.default_rng(i)) for i in range(1_000))
    return itertools.islice((pair for pair in found if pair.kind == kind), number)


@pytest.mark.parametrize("kind", ["same", "mirrored", "scaled", "other"])
def test_pairs_are_what_they_are_said_to_be(kind):
    for pair in drawn(kind, 4):
        moved = np.asarray(pair.pose.apply(pair.source))
        spacing = np.median(KDTree(pair.target).query(pair.target, k=2)[0][:, 1])
        far = np.quantile(KDTree(pair.target).query(moved)[0], 0.2) / spacing
        if kind == "same":
            assert far < 3
        assert min(len(pair.source), len(pair.target)) > 60
        assert pair.rotations == "any" or np.degrees(pair.pose.angle()) < pair.rotations + 10


def test_bounds_are_known_for_some_pairs_and_kinds_have_their_shares():
    pairs = [draw(BODIES, 0, np.random.default_rng(i)) for i in range(150)]
    assert {pair.rotations for pair in pairs} == {"any", BOUND_DEG}
    assert np.mean([pair.kind == "same" for pair in pairs]) == pytest.approx(0.65, abs=0.12)


def test_a_camera_sees_the_side_of_a_ball_that_faces_it():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(4_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    seen = visible(ball, np.array([0, 0, 3.0]))
    assert seen[:, 2].min() > 0.1
    assert len(seen) == pytest.approx(np.sum(ball[:, 2] > 1 / 3), rel=0.15)


def test_a_pose_is_right_within_5_degrees_and_5_hundredths():
    def turned(deg, shift):
        from scipy.spatial.transform import Rotation

        return RigidTransform(Rotation.from_euler("x", deg, degrees=True).as_matrix(), np.array([shift, 0, 0]))

    true = turned(30, 0.2)
    assert is_right(turned(34.9, 0.249), true)
    assert not is_right(turned(35.1, 0.2), true)
    assert not is_right(turned(30, 0.251), true)


def rows(count: int, seed: int) -> list[dict]:
    """Pairs of five candidates, one of them right with a probability that grows as its cost falls, and in one pair of four none."""
    rng = np.random.default_rng(seed)
    made = []
    for i in range(count):
        cost, other = rng.uniform(0, 2, 5), rng.uniform(0, 2, 5)
        shares = np.exp(-4 * cost)
        right = np.arange(5) == (rng.choice(5, p=shares / shares.sum()) if i % 4 else -1)
        numbers = [dict.fromkeys(calibrate.CHOICE, float(o)) | {"cost": float(c)} for c, o in zip(cost, other, strict=True)]
        candidates = [{"right": bool(r), "numbers": n} for r, n in zip(right, numbers, strict=True)]
        made.append({"object": f"{i}", "kind": "same", "candidates": candidates})
    return made


def test_both_models_are_found_again(monkeypatch):
    monkeypatch.setattr(calibrate, "RIDGE", 1e-6)
    choice = fit_choice(rows(3_000, 0))
    assert choice["cost"] == pytest.approx(-4, rel=0.15)
    weights = {"choice": choice}
    weights["confidence"] = fit_confidence([best_of(row, weights) for row in rows(3_000, 1)])
    best = [best_of(row, weights) for row in rows(3_000, 2)]
    sure, right = (np.array([getattr(each, name) for each in best]) for name in ("confidence", "right"))
    for low in (0.3, 0.5, 0.7):
        inside = (sure >= low) & (sure < low + 0.2)
        assert right[inside].mean() == pytest.approx(sure[inside].mean(), abs=0.08)


def test_the_report_counts_what_is_not_trusted():
    best = [
        Best({}, right=True, found=True, kind="same", confidence=0.9),
        Best({}, right=False, found=True, kind="same", confidence=0.65),
        Best({}, right=False, found=False, kind="other", confidence=0.1),
    ]
    lines = report("held out", best)
    assert lines[0] == "held out: 3 pairs, 2 of one object: right 50.0%, right among the candidates 100.0%; calibration error 0.283"
    assert "not trusted below 0.6: wrong 50.0% of 2, wrong, same object 0.0% of 1, right 0.0% of 1, other 100.0% of 1" in lines[3]


def test_an_interrupted_search_continues_and_weights_are_written(tmp_path, capsys):
    small = {"workers": 1, "held_out": 0.4}
    main(Command(tmp_path / "whole", pairs=6, weights=tmp_path / "weights.json", **small))
    assert "held out: " in capsys.readouterr().out
    weights = json.loads((tmp_path / "weights.json").read_text())
    assert set(weights) == {"choice", "confidence"}
    whole = (tmp_path / "whole" / "pairs-0.jsonl").read_text()
    (tmp_path / "cut").mkdir()
    (tmp_path / "cut" / "pairs-0.jsonl").write_text(whole[: len(whole) // 2])
    main(Command(tmp_path / "cut", pairs=6, **small))
    assert (tmp_path / "cut" / "pairs-0.jsonl").read_text() == whole
