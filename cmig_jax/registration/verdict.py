"""Which of several poses is the right one, and whether it can be trusted: two logistic models of what speaks for a pose.

`calibrate` fits both on training objects and writes their weights into `verdict.json`; `docs/choosing.md` says what they are worth.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cmig_jax.registration.evidence import evidence, turn_deg
from cmig_jax.registration.levels import Level
from cmig_jax.registration.search import Candidate

TRUSTED = 0.5
MOST_WEIGHED = 32
ANY_OVERLAP = 5
"""A cloud that is so many times smaller lies within the other one at any pose."""
CLOSE = 0.1
"""Two poses fit equally well if the one is at least so many times as probable as the other."""
_FEW = 0.3
"""What is added to the number of starts that led to a pose."""
WEIGHTS = Path(__file__).with_suffix(".json")


@dataclass(frozen=True)
class Weighed:
    """A candidate and what was found about it.

    Attributes:
        candidate: the pose.
        numbers: of `evidence`, and `starts`, the logarithm of the share of starts that led to it, and `turn`, its angle over the bound on
            the rotation (0 without one).
        probability: that it is the right one, if one of the candidates is.
    """

    candidate: Candidate
    numbers: Mapping[str, float]
    probability: float


def weigh(source: Level, target: Level, candidates: Sequence[Candidate], limit_deg: float = 180.0) -> list[Weighed]:
    """Weigh candidates against each other.

    Args:
        source, target: the clouds.
        candidates: best fit first; the first `MOST_WEIGHED` are weighed.
        limit_deg: bound on the rotation.

    Returns:
        The most probable first.
    """
    numbers = numbers_of(source, target, candidates, limit_deg)
    scores = np.array([weighted_sum(weights()["choice"], found) for found in numbers])
    shares = np.exp(scores - scores.max())
    shares /= shares.sum()
    weighed = [Weighed(*each) for each in zip(candidates, numbers, shares.tolist(), strict=False)]
    return sorted(weighed, key=lambda each: -each.probability)


def numbers_of(source: Level, target: Level, candidates: Sequence[Candidate], limit_deg: float) -> list[dict[str, float]]:
    """Return the numbers of `Weighed` for the first `MOST_WEIGHED` candidates."""
    starts = sum(candidate.starts for candidate in candidates)

    def numbers(candidate: Candidate) -> dict[str, float]:
        return {
            **evidence(source, target, candidate.matrix),
            "starts": float(np.log((candidate.starts + _FEW) / (starts + _FEW))),
            "turn": turn_deg(candidate.matrix) / max(limit_deg, 1.0) if limit_deg < 180 else 0.0,
        }

    return [numbers(candidate) for candidate in candidates[:MOST_WEIGHED]]


def confidence(best: Weighed) -> float:
    """Return the estimated probability that the best pose is right, the possibility that none of the candidates is included."""
    found = {**best.numbers, "probability": float(np.log(best.probability)), "one": 1.0}
    return float(1 / (1 + np.exp(-weighted_sum(weights()["confidence"], found))))


def explain(confident: float, best: Weighed, ratio: float) -> str:
    """Say in one sentence what decided.

    Args:
        confident: the confidence.
        best: the best pose.
        ratio: radius of the larger cloud over that of the smaller.
    """
    if confident >= TRUSTED:
        return "aligned"
    overlap = best.candidate.fit.overlap
    if ratio > 1.2 and (max(overlap) < 0.8 or ratio > ANY_OVERLAP):
        return f"the clouds do not fit; their sizes differ: {ratio:.3g} : 1"
    if min(overlap) < 0.3:
        return "the clouds share too little"
    if best.probability < 1 / (1 + CLOSE):
        return "two poses fit equally well: a symmetric object?"
    return "no pose that was tried fits well"


def weighted_sum(given: Mapping[str, float], found: Mapping[str, float]) -> float:
    """Return the sum of numbers times their weights."""
    return sum(weight * found[name] for name, weight in given.items())


@functools.cache
def weights() -> dict[str, dict[str, float]]:
    """Read the weights of the `choice` and of the `confidence`."""
    return json.loads(WEIGHTS.read_text(encoding="utf-8"))
