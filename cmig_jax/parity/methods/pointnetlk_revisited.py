"""PointNetLK Revisited (Li et al., CVPR 2021): its `state_dict`, and its recorded cases."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cmig_jax.models.pointnetlk.flags import PointNetLKFlags, revisited
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, normalisation, pointnet_path, widths_of
from cmig_jax.parity.method import Method, Outcome
from cmig_jax.parity.weights import Tensor
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

INPUTS = {
    "src": "B N 3",
    "tgt": "B M 3",
    "R_gt": "B 3 3",
    "t_gt": "B 3",
    "igt": "B 4 4",
    "maxiter": "",
    "batchnorm_idx": "T D",
    "random_idx": "D",
}
DRAWS = ("batchnorm_idx", "random_idx")
STAGES = {
    "PointNetLK.jacobian": lambda _: ("feat_tgt", "argmax_tgt", "J", "pinv"),
    "PointNetLK.iterate": lambda _: ("G_R", "G_t", "residual", "before", "xi", "done"),
}


def flags_of_case(case: Case) -> PointNetLKFlags:
    """Return the flags that a case was recorded with."""
    n, drawn = int(case.inputs["maxiter"]), case.inputs.get("random_idx", ())
    return replace(revisited(), iterations=n, test_iterations=n, training_points=len(drawn))


def flags_of_state(state: State) -> PointNetLKFlags:
    """Return the flags of a network with the widths of a state."""
    return replace(revisited(), widths=widths_of(state, "ptnet.mlp{}.0"))


def layout(flags: PointNetLKFlags) -> list[Tensor]:
    """List the tensors of the `state_dict` in order."""
    tensors = []
    for i, (inputs, width) in enumerate(itertools.pairwise((3, *flags.widths))):
        tensors += linear(f"ptnet.mlp{i + 1}.0", (width, inputs, 1), pointnet_path("layer", i, flags.widths))
        tensors += normalisation(f"ptnet.mlp{i + 1}.1", width, pointnet_path("norm", i, flags.widths))
    return tensors


def batch(inputs: Mapping[str, Any]) -> Batch:
    """Return the pairs of a case."""
    return Batch(inputs["src"], inputs["tgt"], target_from_source=RigidTransform.from_matrix(inputs["igt"]).inverse())


def draws(case: Case) -> Arrays:
    """Return the drawn points of a training case. Of the table for the statistics only the first row has an effect."""
    inputs = case.inputs
    if "random_idx" not in inputs:
        return {}
    return {"statistics_index": inputs["batchnorm_idx"][0], "point_index": inputs["random_idx"]}


def results(outcome: Outcome) -> Arrays:
    """Name the results as the case does."""
    seen, done = outcome.stages, outcome.stages["done"]
    updates = int(np.sum(~done))
    iterations = min(updates + 1, len(done))
    residual = np.moveaxis(seen["residual"], 0, 1)[:, :iterations]
    T = outcome.prediction.target_from_source
    return {
        **{name: seen[name] for name in ("feat_tgt", "argmax_tgt", "J", "pinv")},
        "H": np.einsum("bci,bcj->bij", seen["J"], seen["J"]),
        "feat_src_first": seen["residual"][0] + seen["feat_tgt"],
        "residual": residual,
        **{f"residual/{i}": residual[:, i] for i in range(iterations)},
        "residual_norm": np.linalg.norm(residual, axis=-1),
        "xi": np.moveaxis(seen["xi"], 0, 1)[:, :iterations],
        "G": np.moveaxis(RigidTransform(seen["G_R"], seen["G_t"]).as_matrix(), 0, 1)[:, :updates],
        "iterations": np.asarray(iterations),
        "T": T.as_matrix(),
        "R": T.R,
        "t": T.t,
        **{f"loss_terms/{name}": value for name, value in outcome.terms.items()},
    }


POINTNETLK_REVISITED = Method(
    name="pointnetlk_revisited",
    network="pointnetlk",
    flags_of_case=flags_of_case,
    flags_of_state=flags_of_state,
    layout=layout,
    inputs=INPUTS,
    optional=DRAWS,
    batch=batch,
    draws=draws,
    stages=STAGES,
    results=results,
)
