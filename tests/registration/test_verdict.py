"""The verdict: the right pose among others, what its confidence is made of, and the sentence that says why."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.registration import verdict
from cmig_jax.registration.fit import fit
from cmig_jax.registration.frame import matrix_of
from cmig_jax.registration.levels import Level
from cmig_jax.registration.search import Candidate
from cmig_jax.registration.verdict import confidence, explain, weigh

from .test_register import surface


@pytest.fixture(scope="module")
def clouds():
    return Level(surface(700, 0)), Level(surface(600, 1))


def candidates(clouds, *turns_deg, starts=1):
    poses = [matrix_of(Rotation.from_euler("z", turn, degrees=True).as_matrix(), np.zeros(3)) for turn in turns_deg]
    return [Candidate(pose, fit(*clouds, pose), starts) for pose in poses]


def test_the_right_pose_is_the_most_probable_wherever_it_stands(clouds):
    for turns in ((0, 90, 180), (180, 90, 0)):
        first, *others = weigh(*clouds, candidates(clouds, *turns))
        np.testing.assert_array_equal(first.candidate.matrix, np.eye(4))
        assert first.probability > 0.9
        assert first.probability + sum(each.probability for each in others) == pytest.approx(1)
        assert [each.probability for each in others] == sorted((each.probability for each in others), reverse=True)


def test_many_starts_that_agree_speak_for_a_pose(clouds):
    one, other = candidates(clouds, 0, 0)
    first, _ = weigh(*clouds, [replace(one, starts=1), replace(other, starts=300)])
    assert first.candidate.starts == 300


def test_of_two_poses_the_smaller_turn_is_likelier_where_turns_are_bounded(clouds):
    numbers = [each.numbers["turn"] for each in weigh(*clouds, candidates(clouds, 0, 60), limit_deg=80)]
    assert numbers == pytest.approx([0, 0.75])
    assert {each.numbers["turn"] for each in weigh(*clouds, candidates(clouds, 0, 60))} == {0}
    assert verdict.weights()["choice"]["turn"] < 0


def test_confidence_falls_where_another_pose_is_as_probable(clouds):
    alone = weigh(*clouds, candidates(clouds, 0))[0]
    assert alone.probability == 1
    assert confidence(alone) > confidence(replace(alone, probability=0.5)) > confidence(replace(alone, probability=0.2))


def test_the_weights_name_what_is_measured(clouds):
    measured = set(weigh(*clouds, candidates(clouds, 0))[0].numbers)
    assert set(verdict.weights()["choice"]) <= measured
    assert set(verdict.weights()["confidence"]) == measured | {"probability", "one"}


@pytest.mark.parametrize(
    ("confident", "overlap", "probability", "ratio", "message"),
    [
        (0.9, (0.2, 0.2), 0.5, 2.0, "aligned"),
        (0.1, (0.5, 0.4), 0.5, 1.9, "the clouds do not fit; their sizes differ: 1.9 : 1"),
        (0.1, (0.5, 0.2), 0.5, 1.0, "the clouds share too little"),
        (0.1, (0.8, 0.8), 0.6, 1.0, "two poses fit equally well: a symmetric object?"),
        (0.1, (0.8, 0.8), 0.99, 1.0, "no pose that was tried fits well"),
    ],
)
def test_one_sentence_says_what_decided(clouds, confident, overlap, probability, ratio, message):
    best = weigh(*clouds, candidates(clouds, 0))[0]
    best = replace(best, probability=probability, candidate=replace(best.candidate, fit=replace(best.candidate.fit, overlap=overlap)))
    assert explain(confident, best, ratio) == message
