"""The format of recorded cases: summaries, reading, refusing; and the random inputs."""

import numpy as np
import pytest

from cmig_jax.parity.cases import NAMES, PACKED, as_recorded, read_cases
from cmig_jax.parity.inputs import random_inputs

AXES = {"src": "B 3 N", "tgt": "B 3 N", "index": "B K"}
GIVEN = {"src": np.zeros((2, 3, 5)), "tgt": np.ones((2, 3, 5))}


def test_summaries_are_computed_from_results():
    rng = np.random.default_rng(0)
    value, gradient = rng.standard_normal((2, 4, 1000)), rng.standard_normal((3, 4, 1))
    run = {"it0/F": value, "gradient/a.weight": gradient, "statistics/bn.running_var": np.array([1.0, 2.0])}
    assert as_recorded("it0/F", run) is value
    assert np.array_equal(as_recorded("it0/F/head", run), value[..., :8])
    assert as_recorded("it0/F/stats", run) == pytest.approx([value.mean(), value.std(), abs(value).max(), value.ravel()[::997].sum()])
    assert as_recorded("grad_norm/a.weight", run) == pytest.approx(np.sqrt((gradient**2).sum()))
    assert as_recorded("buffer_sum/bn.running_var", run) == 3
    for key in ("it0/F/tail", "it1/F", "grad_norm/b.weight", "buffer_sum/b", "stats"):
        assert as_recorded(key, run) is None


def test_a_case_is_read(tmp_path):
    np.savez(tmp_path / "a.npz", **GIVEN, index=np.zeros((2, 4)), **{"it0/logit": np.zeros((2, 4)), "R": np.ones((2, 3, 3))})
    (case,) = read_cases(tmp_path / "a.npz", AXES, ("index",))
    assert list(case.inputs) == ["src", "tgt", "index"]
    assert list(case.outputs) == ["it0/logit", "R"]


def test_a_file_holds_both_modes_and_packed_outputs(tmp_path):
    names = np.array(["loss", "R 2 3 3", "none 0 4", "evaluation/R 2 3 3"], "S")
    np.savez(tmp_path / "a.npz", **GIVEN, index=np.zeros((2, 4)), **{PACKED: np.arange(37.0), NAMES: names})
    training, evaluation = read_cases(tmp_path / "a.npz", AXES, ("index",))
    assert {key: value.shape for key, value in training.outputs.items()} == {"loss": (), "R": (2, 3, 3), "none": (0, 4)}
    assert (training.outputs["loss"], training.outputs["R"][1, 2, 2], evaluation.outputs["R"][0, 0, 0]) == (0, 18, 19)
    assert (list(training.inputs), list(evaluation.inputs)) == (["src", "tgt", "index"], ["src", "tgt"])


def test_files_that_are_no_case_are_refused(tmp_path):
    path, whole = tmp_path / "a.npz", tmp_path / "whole.npz"
    np.savez(whole, **GIVEN, R=np.zeros((2, 3, 3)))
    np.save(tmp_path / "one.npy", np.zeros(3))
    for content in (b"", b"not numpy", whole.read_bytes()[:500], (tmp_path / "one.npy").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"a\.npz: expected a recorded case"):
            read_cases(path, AXES, ("index",))
    with pytest.raises(ValueError, match=r"absent\.npz: expected a recorded case"):
        read_cases(tmp_path / "absent.npz", AXES)
    for arrays, reason in (
        ({"src": GIVEN["src"]}, "it has no tgt"),
        (GIVEN, "it has no outputs"),
        (GIVEN | {"tgt": np.zeros((2, 3, 6)), "R": np.zeros(1)}, r"tgt has shape \(2, 3, 6\), expected \[B, 3, N\] with {'B': 2, 'N': 5}"),
        (GIVEN | {"src": np.zeros((2, 4, 5)), "R": np.zeros(1)}, r"src has shape \(2, 4, 5\), expected \[B, 3, N\]"),
        (GIVEN | {"src": np.zeros((2, 3)), "R": np.zeros(1)}, r"src has shape \(2, 3\), expected \[B, 3, N\]"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match=reason):
            read_cases(path, AXES, ("index",))


def test_random_inputs_obey_the_true_pose():
    inputs = random_inputs(3, pairs=2, points=60, views=2, size=20)
    assert {name: value.shape for name, value in inputs.items()} == {
        "src": (2, 3, 60),
        "tgt": (2, 3, 60),
        "views": (2, 2, 3, 20, 20),
        "R_gt": (2, 3, 3),
        "t_gt": (2, 3),
    }
    moved = inputs["R_gt"] @ inputs["src"] + inputs["t_gt"][..., None]
    nearest = np.linalg.norm(moved[:, :, :, None] - inputs["tgt"][:, :, None, :], axis=1).min(2)
    assert np.mean(nearest < 0.05) > 0.6  # the crops of the two clouds differ
    assert np.array_equal(random_inputs(3, 2, 60, 1, 8)["src"], inputs["src"])
