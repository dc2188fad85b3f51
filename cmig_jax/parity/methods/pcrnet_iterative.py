"""Iterative PCRNet (Sarode et al., 2019): its `state_dict`, and its recorded cases."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from typing import Any

from cmig_jax.models.pcrnet.flags import PCRNetFlags
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, pointnet_path, widths_of
from cmig_jax.parity.method import Method, Outcome, pair_batch
from cmig_jax.parity.weights import Tensor
from cmig_jax.transform import RigidTransform

INPUTS = {"src": "B N 3", "tgt": "B M 3", "R_gt": "B 3 3", "t_gt": "B 3"}
STEP = ("feat_src", "pose7_raw", "R", "t", "src")
STAGES = {"PCRNet.register": lambda _: ("feat_tgt", *STEP)}


def flags_of_case(case: Case) -> PCRNetFlags:
    """Return the flags that a case was recorded with."""
    return PCRNetFlags(iterations=len({key.partition("/")[0] for key in case.outputs if re.match(r"it\d+/", key)}))


def flags_of_state(state: State) -> PCRNetFlags:
    """Return the flags of a network with the widths of a state."""
    widths, head = widths_of(state, "feature_model.conv{}"), widths_of(state, "linear.{}")
    return PCRNetFlags(widths=widths, head_widths=head[:-1])


def layout(flags: PCRNetFlags) -> list[Tensor]:
    """List the tensors of the `state_dict` in order."""
    tensors = []
    for i, (inputs, width) in enumerate(itertools.pairwise((3, *flags.widths))):
        tensors += linear(f"feature_model.conv{i + 1}", (width, inputs, 1), pointnet_path("layer", i, flags.widths))
    for i, (inputs, width) in enumerate(itertools.pairwise((2 * flags.widths[-1], *flags.head_widths, 7))):
        tensors += linear(f"linear.{2 * i}", (width, inputs), f"head/layer_{i}")
    return tensors


def overrides(case: Case) -> Mapping[str, tuple[str, Any]]:
    """Return the changes that make the recorded network turn by small angles."""
    last = f"linear.{2 * len(flags_of_case(case).head_widths)}"
    return {f"{last}.weight": ("*", 0.1), f"{last}.bias": ("+", [1.0, 0, 0, 0, 0, 0, 0])}


def results(outcome: Outcome) -> Arrays:
    """Name the results as the case does; its pose is that of the centred clouds."""
    seen = outcome.stages
    pose = RigidTransform(seen["R"][-1], seen["t"][-1])
    steps = {f"it{i}/{name}": seen[name][i] for i in range(len(seen["R"])) for name in STEP}
    whole = {"R": pose.R, "t": pose.t, "T": pose.as_matrix(), "feature_residual": seen["feat_tgt"] - seen["feat_src"][-1]}
    return {"feat_tgt": seen["feat_tgt"], **steps, **whole}


PCRNET_ITERATIVE = Method(
    name="pcrnet_iterative",
    network="pcrnet",
    flags_of_case=flags_of_case,
    flags_of_state=flags_of_state,
    layout=layout,
    inputs=INPUTS,
    batch=pair_batch,
    stages=STAGES,
    results=results,
    overrides=overrides,
)
