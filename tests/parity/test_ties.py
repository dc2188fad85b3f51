"""Choices between values that are equal up to rounding are named, and count as holding; all else fails as before."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from cmig_jax.models.cmignet.flags import MatchingFlags
from cmig_jax.parity import cmignet_ties as ties
from cmig_jax.parity import cmignet_twin_parts as parts
from cmig_jax.parity.cases import Case
from cmig_jax.parity.cmignet_check import check
from cmig_jax.parity.cmignet_compare import run_twin
from cmig_jax.parity.cmignet_layout import layout, small
from cmig_jax.parity.cmignet_twin import Twin
from cmig_jax.parity.inputs import random_inputs
from cmig_jax.parity.rows import table
from cmig_jax.parity.weights import named_weights

from .recording import record

torch.set_num_threads(1)
FLAGS = replace(small(), matching=MatchingFlags(iterations=1, feature_widths=(8,), coordinate_widths=(8,)))
SEED = 10  # the poses are well determined
STATE = named_weights(layout(FLAGS), SEED)
ROUNDING = 1e-11


def twice(cloud):
    """Repeat every point: the two have equal features, scores and logits, up to rounding."""
    return np.concatenate([cloud, cloud], axis=-1)


@pytest.fixture(scope="module")
def inputs():
    single = random_inputs(0, pairs=2, points=40, views=1, size=32)
    return single | {name: twice(single[name]) for name in ("src", "tgt")}


@pytest.fixture(scope="module")
def case(inputs) -> Case:
    return record(FLAGS, inputs, train=False, seed=SEED)


def outcome(case, dtype="float64"):
    """Check a case: the rows that fail, and the notes of those that tie."""
    rows = check(case, FLAGS, STATE, dtype, "plain")
    return {row.key for row in rows if not row.holds}, {row.key: row.note for row in rows if row.tie}


@pytest.fixture(scope="module")
def decided(inputs) -> list[Case]:
    """Record with medians that decide between equal logits by their position, first and last."""
    weights, cases = parts.weights, []
    with pytest.MonkeyPatch.context() as patch:
        for sign in (1e-14, -1e-14):
            jitter = sign * torch.arange(FLAGS.keypoints.count)
            patch.setattr(parts, "weights", lambda logit, jitter=jitter: weights(logit + jitter.to(logit)))
            cases.append(record(FLAGS, inputs, train=False, seed=SEED))
    assert not np.array_equal(cases[0].outputs["it0/svd_w"] > 0, cases[1].outputs["it0/svd_w"] > 0)
    return cases


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_median_between_equal_logits(decided, dtype):
    """K = 24 keypoints are 12 pairs of equal ones: the lower median, the 12th value, is one of a pair."""
    tied = {}
    for case in decided:  # our network can decide like one of them, not like both
        failing, notes = outcome(case, dtype)
        assert not failing
        tied |= notes
    assert set(tied) == {"it0/svd_w", "it0/R", "it0/t"} | ({"R", "t"} if dtype == "float64" else set())
    assert tied["it0/svd_w"].startswith("median of it0/logit, pair ")
    assert tied["it0/svd_w"].endswith(("differ by 0e+00", "e-16", "e-17"))


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_losses_and_gradients_that_follow_from_a_tie(inputs, dtype, monkeypatch):
    rng, half, weights = np.random.default_rng(0), FLAGS.keypoints.count // 2, parts.weights
    drawn = np.stack([rng.permutation(40)[:half] for _ in range(2)])
    training = inputs | {"src_idx": np.concatenate([drawn, drawn + 40], axis=1)}  # every keypoint twice
    jitter = 1e-14 * torch.arange(FLAGS.keypoints.count)
    monkeypatch.setattr(parts, "weights", lambda logit: weights(logit + jitter.to(logit)))
    flags = replace(FLAGS, matching=replace(FLAGS.matching, iterations=2))
    state = named_weights(layout(flags), 3)
    recorded = run_twin(Twin(flags, state), training, train=True)
    del recorded["src_idx"]
    rows = check(Case(training, recorded), flags, state, dtype, "plain")
    assert all(row.holds for row in rows), table([row for row in rows if not row.holds])
    tied = {row.key for row in rows if row.tie}
    later = {"it1/match_S", "loss_terms", "gradient/emb_nn.conv1.weight"}
    assert {"it0/R", "it1/svd_w"} <= tied
    assert later <= tied if dtype == "float64" else not later & tied


@pytest.mark.parametrize("key", ["score_a", "it0/logit", "it0/svd_w", "t"])
def test_other_faults_still_fail_beside_a_tie(decided, key):
    """Before the tie, at it, after it, and at the end."""
    failing, tied = set(), set()
    for case in decided:
        found = outcome(replace(case, outputs=case.outputs | {key: np.where(case.outputs[key] != 0, case.outputs[key] + 1e-6, 0)}))
        failing, tied = failing | found[0], tied | set(found[1])
    assert failing == {key}
    assert {"it0/R", "it0/t"} <= tied


def test_a_choice_between_different_values_fails(case):
    """With weights for other keypoints, neither the choice nor what follows from the tie beside it is excused."""
    outputs = case.outputs | {"it0/svd_w": np.roll(case.outputs["it0/svd_w"], 1, axis=1)}
    failing, tied = outcome(replace(case, outputs=outputs))
    assert "it0/svd_w" in failing
    assert not {"it0/svd_w", "it0/R", "it0/t"} & set(tied)


def test_an_argmax_over_equal_columns_and_an_order_of_equal_scores(case):
    """Take the other one of each pair of equal points, which changes nothing else."""
    recorded, points = ties.recorded_choices(case, FLAGS.keypoints.count), case.inputs["src"].shape[-1] // 2
    assert list(recorded) == ["src_chosen", "tgt_chosen", "it0/chosen", "it0/kept"]
    equal = recorded["tgt_chosen"][:, None] % points == recorded["tgt_chosen"][:, :, None] % points
    partner = np.argmax(equal & ~np.eye(FLAGS.keypoints.count, dtype=bool), axis=-1)
    others = {
        "it0/chosen": ("argmax of it0/match", np.take_along_axis(partner, recorded["it0/chosen"], axis=1)),
        "src_chosen": ("order of score_a", (recorded["src_chosen"] + points) % (2 * points)),
    }
    for key, (what, value) in others.items():
        assert not (value == recorded[key]).any()
        failing, tied = outcome(replace(case, outputs=case.outputs | {key: value.astype(np.float64)}))
        assert not failing
        assert tied[key].startswith(f"{what}, pair 0, 1: two values differ by ")


def near(rng, shape):
    """Draw values of which many are equal up to rounding."""
    return rng.integers(-3, 3, shape) + 1e-13 * rng.standard_normal(shape)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("K", [7, 8])
def test_moved_values_choose_as_recorded(seed, K):
    rng = np.random.default_rng(seed)
    ours, theirs = (near(np.random.default_rng(seed), (3, K)) for _ in range(2))
    theirs = np.round(ours) + 1e-13 * rng.standard_normal((3, K)) * rng.integers(0, 2, (3, 1))  # in some rows exactly equal

    def kept(logit):
        return (logit >= np.sort(logit, axis=1)[:, (K - 1) // 2, None]).astype(int)

    def order(score):
        return np.argsort(-score, axis=1, kind="stable")[:, :4]

    rules = (("it0/kept", kept, "it0/logit"), ("src_chosen", order, "score_a"), ("tgt_chosen", order, "score_b"))
    for name, choose, source in rules:
        note, moved = ties.resolve(name, choose(ours), choose(theirs), {source: ours}, "float64")
        assert bool(moved) == bool(note) == (not np.array_equal(choose(ours), choose(theirs)))
        if moved:
            assert np.array_equal(choose(moved[source]), choose(theirs))
            assert np.abs(moved[source] - ours).max() < 4 * ROUNDING * np.abs(ours).max()
            different = ours + rng.standard_normal((3, K))
            assert ties.resolve(name, choose(different), choose(theirs), {source: different}, "float64") == ("", {})


@pytest.mark.parametrize("seed", range(5))
def test_moved_similarities_choose_as_recorded(seed):
    rng = np.random.default_rng(seed)
    F, S, other = near(rng, (2, 6, 5)), near(rng, (2, 6, 5)), 1e-13 * rng.standard_normal((2, 6, 5))
    ours, recorded = np.argmax(F + S, axis=-1), np.argmax(np.round(F + S) + other, axis=-1)
    _, moved = ties.resolve("it0/chosen", ours, recorded, {"it0/match_F": F, "it0/match_S": S}, "float64")
    assert moved
    assert np.array_equal(np.argmax(moved["it0/match_F"] + S, axis=-1), recorded)
    assert np.abs(moved["it0/match_F"] - F).max() < 4 * ROUNDING * np.abs(F + S).max()
