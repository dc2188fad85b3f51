"""What the patch transformer returns."""

from __future__ import annotations

from flax import struct
from jax import Array

from cmig_jax.structs import Prediction
from cmig_jax.transform import RigidTransform


@struct.dataclass
class Matches:
    """One pass.

    Attributes:
        source, target: `[B, K, 3]`, `[B, L, 3]` centres of the patches, the source's as the passes before have moved them.
        match: `[B, K, L]` similarities.
        corresponding: `[B, K, 3]` soft correspondents of the source's centres: means of the target's under the softmax of a row.
        source_logit, target_logit: `[B, K]`, `[B, L]` logits of having a correspondent.
        weight: `[B, K]` of the correspondences in the pose; they sum to 1.
        step: `[B]` the pose from the moved source to the target.
    """

    source: Array
    target: Array
    match: Array
    corresponding: Array
    source_logit: Array
    target_logit: Array
    weight: Array
    step: RigidTransform


@struct.dataclass(kw_only=True)
class PatchPrediction(Prediction):
    """What the network returns; `matches` are those of the last pass."""

    matches: Matches
