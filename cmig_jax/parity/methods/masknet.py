"""MaskNet (Sarode et al., 3DV 2020): its `state_dict`, and its recorded cases."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from cmig_jax.config import ComputeConfig
from cmig_jax.models.masknet.flags import MaskNetFlags
from cmig_jax.models.masknet.network import losses
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, normalisation, pointnet_path, widths_of
from cmig_jax.parity.method import Method, Outcome, channels_second, pair_batch
from cmig_jax.parity.weights import Tensor

# The recorded order of the chosen points is arbitrary: `mask_idx` is read to put ours in that order.
INPUTS = {"src": "B N 3", "tgt": "B M 3", "mask_gt": "B M", "R_gt": "B 3 3", "t_gt": "B 3", "mask_idx": "B K"}
STAGES = {
    "PointNet.pooled": lambda _: ("feat_src_pooled",),
    "PointNet.__call__": lambda i: ((), ("feat_tgt",))[i],
    "MaskNet.score": lambda _: ("h3_hidden_last", "logit"),
}
ENCODER, SCORE = "maskNet.feature_model", "maskNet.h3"
THRESHOLD = 0.5  # of the released code's other way to choose points, for a batch of one


def flags_of_case(case: Case) -> MaskNetFlags:
    """Return the flags that a case was recorded with."""
    return MaskNetFlags()


def flags_of_state(state: State) -> MaskNetFlags:
    """Return the flags of a network with the widths of a state."""
    widths, score = widths_of(state, f"{ENCODER}.conv{{}}"), widths_of(state, f"{SCORE}.{{}}")
    return MaskNetFlags(widths=widths, mask_widths=score[:-1])


def layout(flags: MaskNetFlags) -> list[Tensor]:
    """List the tensors of the `state_dict` in order."""
    sizes, tensors = (3, *flags.widths), []
    for i, (inputs, width) in enumerate(itertools.pairwise(sizes)):
        tensors += linear(f"{ENCODER}.conv{i + 1}", (width, inputs, 1), pointnet_path("layer", i, flags.widths))
    for i, width in enumerate(flags.widths):
        tensors += normalisation(f"{ENCODER}.bn{i + 1}", width, pointnet_path("norm", i, flags.widths))
    paths = ["first/layer", *(f"rest/layer_{i}" for i in range(len(flags.mask_widths) - 1)), "last"]
    sizes = (2 * flags.widths[-1], *flags.mask_widths, 1)
    for i, ((inputs, width), path) in enumerate(zip(itertools.pairwise(sizes), paths, strict=True)):
        tensors += linear(f"{SCORE}.{2 * i}", (width, inputs, 1), path)
    return tensors


def draws(case: Case) -> Arrays:
    """Return the recorded label."""
    return {"label": case.inputs["mask_gt"]}


def overrides(case: Case) -> Mapping[str, tuple[str, Any]]:
    """Return the change that puts the recorded masks on both sides of one half."""
    return {f"{SCORE}.{2 * len(flags_of_case(case).mask_widths)}.bias": ("+", -1.5)}


def results(outcome: Outcome) -> Arrays:
    """Name the results as the case does; a point that is recorded as chosen and was not becomes NaN."""
    seen, prediction, target = outcome.stages, outcome.prediction, outcome.inputs["tgt"]
    recorded, chosen = outcome.inputs["mask_idx"].astype(int)[..., None], prediction.chosen[..., None]
    points = np.full_like(target, np.nan)
    np.put_along_axis(points, chosen, np.take_along_axis(target, chosen, 1), 1)
    with jax.enable_x64(True):
        bce = losses(prediction, pair_batch(outcome.inputs), replace(MaskNetFlags(), loss="bce"), ComputeConfig())
    return {
        "feat_src_pooled": seen["feat_src_pooled"],
        "feat_tgt": channels_second(seen["feat_tgt"]),
        "h3_hidden_last": channels_second(seen["h3_hidden_last"]),
        "logit": seen["logit"],
        "mask": prediction.target_overlap,
        "masked_tgt": np.take_along_axis(points, recorded, 1),
        "threshold_idx_0": np.nonzero(prediction.target_overlap[0] > THRESHOLD)[0],
        "loss_bce": np.asarray(bce["mask"]),
    }


MASKNET = Method(
    name="masknet",
    network="masknet",
    flags_of_case=flags_of_case,
    flags_of_state=flags_of_state,
    layout=layout,
    inputs=INPUTS,
    batch=pair_batch,
    draws=draws,
    stages=STAGES,
    results=results,
    overrides=overrides,
)
