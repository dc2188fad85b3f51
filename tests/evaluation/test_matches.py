"""The correspondences that the report draws, of a network whose every choice is known."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.evaluation.matches import PER_CALL, matches
from cmig_jax.structs import Batch, Correspondences, Prediction
from cmig_jax.transform import RigidTransform

POINTS = 12
SOURCE_INDEX, TARGET_INDEX, PARTNER = [3, 1, 4, 11, 5], [11, 5, 3, 1, 7], [2, 3, 0, 0, 4]
"""Keypoints 3, 1 and 11 of the source meet the same points of the target, 4 and 5 do not."""
WEIGHT = [0.5, 0.0, 0.25, 0.25, 0.0]


def network(*, matching: bool = True) -> Any:
    def predict(variables: dict, batch: Batch) -> Prediction:
        B = len(batch.source)
        assert B == PER_CALL, "one compiled shape"
        indices = (jnp.asarray([x] * B) for x in (SOURCE_INDEX, TARGET_INDEX, PARTNER, WEIGHT))
        return Prediction(RigidTransform.identity((B,)), Correspondences(*indices) if matching else None)

    return SimpleNamespace(variables={}, predictor=SimpleNamespace(predict=predict))


@pytest.fixture
def pairs():
    """Five pairs of the same points in the same order."""
    t = np.array([0.5, 0, 0], np.float32)
    clouds = np.random.default_rng(0).normal(size=(5, POINTS, 3)).astype(np.float32)
    return [{"source": cloud, "target": cloud + t, "R": np.eye(3, dtype=np.float32), "t": t} for cloud in clouds]


def test_what_was_chosen_used_and_right(pairs):
    found = matches(network(), pairs)
    assert len(found) == len(pairs)
    for pair, matched in zip(pairs, found, strict=True):
        assert matched is not None
        np.testing.assert_array_equal(matched.source, pair["source"][SOURCE_INDEX])
        np.testing.assert_array_equal(matched.target, pair["target"][TARGET_INDEX])
        assert matched.chosen.tolist() == PARTNER
        assert matched.used.tolist() == [True, False, True, True, False]
        assert matched.right.tolist() == [True, True, False, True, False]


def test_a_network_without_correspondences(pairs):
    assert matches(network(matching=False), pairs) == [None] * 5
