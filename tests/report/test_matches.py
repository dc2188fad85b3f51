"""The correspondences that the report draws, of a network whose every choice is known."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from cmig_jax.config import Config
from cmig_jax.registration import Network
from cmig_jax.report.matches import PER_CALL, matches
from cmig_jax.structs import Batch, Iteration, Keypoints, Prediction, RigidTransform

POINTS, KEYPOINTS = 12, 5
SOURCE_INDEX, TARGET_INDEX, CORRESPONDENCE = [3, 1, 4, 11, 5], [11, 5, 3, 1, 7], [2, 3, 0, 0, 4]
"""Keypoints 3, 1 and 11 of the source meet the same points of the target, 4 and 5 do not."""
WEIGHT = [0.5, 0.0, 0.25, 0.25, 0.0]


def predict(batch: Batch, last: dict[str, Any]) -> Prediction:
    B = len(batch.source)
    nothing = jnp.zeros((B, 1, 1))
    repeated = {key: jnp.stack([jnp.asarray(value)] * B) for key, value in last.items()}
    return Prediction(
        source_features=nothing,
        target_features=nothing,
        source_fused=nothing,
        target_fused=nothing,
        keypoints=Keypoints(jnp.asarray([SOURCE_INDEX] * B), jnp.asarray([TARGET_INDEX] * B)),
        iterations=tuple(Iteration(source=nothing, step=RigidTransform.identity((B,)), **found) for found in ({}, repeated)),
        target_from_source=RigidTransform.identity((B,)),
    )


@pytest.fixture
def make_network():
    def make(**last: Any) -> Network:
        def apply(variables: dict, batch: Batch) -> Prediction:
            assert len(batch.source) == PER_CALL, "one compiled shape"
            return predict(batch, last)

        return Network(Config(), {}, SimpleNamespace(apply=apply), 0)  # type: ignore[arg-type]

    return make


@pytest.fixture
def pairs():
    """Five pairs of the same points in the same order."""
    t = np.array([0.5, 0, 0], np.float32)
    clouds = np.random.default_rng(0).normal(size=(5, POINTS, 3)).astype(np.float32)
    return [{"source": cloud, "target": cloud + t, "R": np.eye(3, dtype=np.float32), "t": t} for cloud in clouds]


def test_what_was_chosen_used_and_right(make_network, pairs):
    found = matches(make_network(correspondence=CORRESPONDENCE, weight=WEIGHT), pairs, 0.01)
    assert len(found) == len(pairs)
    for pair, matched in zip(pairs, found, strict=True):
        assert matched is not None
        np.testing.assert_array_equal(matched.source, pair["source"][SOURCE_INDEX])
        np.testing.assert_array_equal(matched.target, pair["target"][TARGET_INDEX])
        assert matched.chosen.tolist() == CORRESPONDENCE
        assert matched.used.tolist() == [True, False, True, True, False]
        assert matched.right.tolist() == [True, True, False, True, False]


def test_everything_is_right_within_a_large_distance(make_network, pairs):
    (matched,) = matches(make_network(correspondence=CORRESPONDENCE, weight=WEIGHT), pairs[:1], 100.0)
    assert matched is not None
    assert matched.right.all()


def test_a_head_without_correspondences(make_network, pairs):
    assert matches(make_network(), pairs, 0.05) == [None] * 5
