"""Whether a pose can be trusted: a logistic model of what speaks for it, fitted on training objects.

The pairs were made of training objects: 400 to 1,024 points, crops of 50 % to 100 % each, noise of 0 to 0.02, any rotation or one up to 45
degrees about each axis; 28 % of them of two objects, of a mirrored one, or of two sizes. `docs/choosing.md` says what it is worth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

TRUSTED = 0.6
CLOSE = 0.02
"""Two poses fit equally well if their costs differ by less."""
WEIGHTS = {"bias": 5.27, "cost": -2.37, "overlap": 9.6, "larger_overlap": -9.74, "margin": 0.63, "agreement": 0.78}
LEAST_MARGIN, MOST_MARGIN = 1e-3, 0.2


def features(costs: Sequence[float], starts: Sequence[int], overlap: tuple[float, float]) -> dict[str, float]:
    """Return what the confidence is computed from.

    Args:
        costs: of the distinct poses, best first.
        starts: how many starts led to each.
        overlap: of the best pose.

    Returns:
        `cost` of the best pose; `overlap`, the smaller share, and `larger_overlap`; `margin`, the logarithm of what the next pose costs
        more; `agreement`, the logarithm of the share of starts that led to the best pose.
    """
    margin = costs[1] - costs[0] if len(costs) > 1 else MOST_MARGIN
    return {
        "bias": 1.0,
        "cost": costs[0],
        "overlap": min(overlap),
        "larger_overlap": max(overlap),
        "margin": float(np.log(np.clip(margin, LEAST_MARGIN, MOST_MARGIN))),
        "agreement": float(np.log(starts[0] / sum(starts))),
    }


def confidence(found: dict[str, float]) -> float:
    """Return the estimated probability that the pose is right."""
    return float(1 / (1 + np.exp(-sum(WEIGHTS[name] * value for name, value in found.items()))))


def explain(found: dict[str, float], ratio: float) -> str:
    """Say in one sentence what decided.

    Args:
        found: the features.
        ratio: radius of the larger cloud over that of the smaller.
    """
    if confidence(found) >= TRUSTED:
        return "aligned"
    if ratio > 1.2 and found["larger_overlap"] < 0.8:
        return f"the clouds do not fit; their sizes differ: {ratio:.3g} : 1"
    if found["overlap"] < 0.3:
        return "the clouds share too little"
    if found["margin"] < np.log(CLOSE):
        return "two poses fit equally well: a symmetric object?"
    return "no pose that was tried fits well"
