"""Rounding ties of CMIGNet: choices between values that are equal up to rounding.

Such a choice may differ from the recorded one without any fault, and then so does all that follows. The network can be made to choose as
recorded by moving the values that it chooses from, by less than a bound.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cmig_jax.models.cmignet.solve import MATCH_LIMIT
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.rows import Dtype

# A difference up to this share of the largest value is rounding: a few times the largest that logits and similarities are measured to have.
TIE = {"float64": 1e-11, "float32": 3e-5}


def recorded_choices(case: Case, keypoints: int) -> Arrays:
    """Read off a case, in the order of computation, what the reference chose, as far as it is recorded.

    Returns:
        `src_chosen`, `tgt_chosen` `[B, K]`, the keypoints (in evaluation); `it<i>/chosen` `[B, K]`, the target keypoint of each source
        keypoint; `it<i>/kept` `[B, K]`, 1 for the keypoints with a weight.
    """
    outputs, found = case.outputs, {}
    for name, score in (("src_chosen", "score_a"), ("tgt_chosen", "score_b")):
        if "src_idx" not in case.inputs and score in outputs:
            found[name] = np.argsort(-outputs[score], axis=1, kind="stable")[:, :keypoints]
    for key, value in outputs.items():
        i, _, kind = key.partition("/")
        if kind == "svd_w":
            found[f"{i}/kept"] = (value > 0).astype(int)
        elif kind == "match_F" and f"{i}/match_S" in outputs:
            found[f"{i}/chosen"] = np.argmax(_similarity(outputs, i), axis=-1)
        elif key.endswith(("chosen", "/kept")):
            found[key] = value.astype(int)
    return {key: found[key] for key in sorted(found, key=lambda key: (key.startswith("it"), len(key.split("/")[0]), key))}


def resolve(name: str, ours: NDArray, recorded: NDArray, values: State, dtype: Dtype) -> tuple[str, Arrays]:
    """Compare a choice with the recorded one.

    Args:
        name: as in `recorded_choices`.
        ours, recorded: `[B, K]` what was chosen.
        values: what we chose from: scores, similarities and logits by name.
        dtype: what they were computed in.

    Returns:
        Which values tie, and by name values with which the network chooses as recorded; empty if the choices agree, or if some candidates
        differ by more than rounding.
    """
    if ours.shape != recorded.shape or np.array_equal(ours, recorded):
        return "", {}
    i, _, kind = name.partition("/")
    if kind == "kept":
        source, what, score, rule = f"{i}/logit", f"median of {i}/logit", values[f"{i}/logit"], _median
    elif kind == "chosen":
        source, what, score, rule = f"{i}/match_F", f"argmax of {i}/match", _similarity(values, i), _argmax
    else:
        source = "score_a" if name == "src_chosen" else "score_b"
        what, score, rule = f"order of {source}", values[source], _order
    rounding = TIE[dtype] * float(np.abs(score).max())
    gaps, moved = rule(score, ours, recorded, rounding)
    if gaps.max() > rounding:
        return "", {}
    pairs = ", ".join(map(str, np.flatnonzero((ours != recorded).any(axis=1))))
    if kind == "chosen":
        moved = values[source] + (moved - score)
    return f"{what}, pair {pairs}: two values differ by {gaps.max():.0e}", {source: moved}


def _median(logit: NDArray, ours: NDArray, recorded: NDArray, rounding: float) -> tuple[NDArray, NDArray]:
    """Make the kept logits at the border equal, so that the median keeps them all, and those that are not kept smaller."""
    differ = ours != recorded
    border = np.where(ours > 0, logit, np.inf).min(axis=1, keepdims=True)
    top = np.maximum(border, np.where(differ, logit, -np.inf).max(axis=1, keepdims=True))
    raised = np.where((recorded > 0) & (logit <= top) & differ.any(axis=1, keepdims=True), top, logit)
    return np.where(differ, np.abs(logit - border), 0), np.where(differ & (recorded == 0), top - rounding, raised)


def _argmax(similarity: NDArray, ours: NDArray, recorded: NDArray, rounding: float) -> tuple[NDArray, NDArray]:
    best, other = (np.take_along_axis(similarity, index[..., None], axis=-1) for index in (ours, recorded))
    moved = similarity.copy()
    np.put_along_axis(moved, recorded[..., None], np.where((ours != recorded)[..., None], best + rounding, other), axis=-1)
    return best - other, moved


def _order(score: NDArray, ours: NDArray, recorded: NDArray, rounding: float) -> tuple[NDArray, NDArray]:
    descending, others = (np.take_along_axis(score, index, axis=1) for index in (ours, recorded))
    moved = np.minimum(score, descending[:, -1:] - 2 * rounding)
    steps = rounding * np.linspace(0, 1, ours.shape[1])[None]
    np.put_along_axis(moved, recorded, descending - steps, axis=1)
    return np.abs(descending - others), moved


def _similarity(values: State, i: str) -> NDArray:
    return np.clip(values[f"{i}/match_F"] + values[f"{i}/match_S"], -MATCH_LIMIT, MATCH_LIMIT)
