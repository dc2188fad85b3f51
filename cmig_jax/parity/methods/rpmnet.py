"""RPM-Net's recorded cases and its `state_dict`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import jax.numpy as jnp
import numpy as np

from cmig_jax.models.rpmnet.network import RPMNetFlags
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, normalisation
from cmig_jax.parity.method import Method, Outcome
from cmig_jax.parity.weights import Layout, Tensor
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

POINTS = {"points_src": "B N 6", "points_ref": "B M 6", "R_gt": "B 3 3", "t_gt": "B 3"}
BIAS_OF_CASES = [15.0, -1.0]  # beta about 15 and a small alpha, so that the matches are not nearly uniform


def layout(flags: RPMNetFlags) -> Layout:
    """List the tensors of a `state_dict`, in its order."""
    dim = flags.dim
    return [
        *_stack("weights_net.prepool", (4, *flags.parameter_widths), (1,), "parameters/points"),
        *_stack("weights_net.postpool", (flags.parameter_widths[-1], *flags.parameter_head), (), "parameters/pooled"),
        *linear(f"weights_net.postpool.{3 * len(flags.parameter_head)}", (2, flags.parameter_head[-1]), "parameters/last"),
        *_stack("feat_extractor.prepool", (10, dim, dim, 2 * dim), (1, 1), "features/edges"),
        *_stack("feat_extractor.postpool", (2 * dim, 2 * dim, dim), (1,), "features/pooled"),
        *linear("feat_extractor.postpool.6", (dim, dim, 1), "features/last"),
    ]


def _stack(name: str, widths: tuple[int, ...], unit: tuple[int, ...], path: str) -> Iterator[Tensor]:
    """List layers of linear, GroupNorm and ReLU, which count as three modules of a sequence each."""
    for i, (inputs, width) in enumerate(itertools.pairwise(widths)):
        yield from linear(f"{name}.{3 * i}", (width, inputs, *unit), f"{path}/layer_{i}")
        yield from normalisation(f"{name}.{3 * i + 1}", width, f"{path}/norm_{i}", running=False)


def flags_of_state(state: State) -> RPMNetFlags:
    """Return the flags of the network with these shapes."""

    def widths(name: str) -> tuple[int, ...]:
        """Return the channels of the normalised layers of a stack."""
        norms = itertools.takewhile(lambda norm: norm in state, (f"{name}.{3 * i + 1}.weight" for i in itertools.count()))
        return tuple(len(state[norm]) for norm in norms)

    before, after, local = (widths(name) for name in ("weights_net.prepool", "weights_net.postpool", "feat_extractor.prepool"))
    if not (before and after and local):
        raise ValueError("not a state of RPM-Net: expected weights_net.prepool, weights_net.postpool and feat_extractor.prepool")
    return RPMNetFlags(dim=local[0], parameter_widths=before, parameter_head=after)


def flags_of_case(case: Case) -> RPMNetFlags:
    """Return the official flags, with as many iterations as the case has."""
    iterations = len({key.split("/")[0] for key in case.outputs if key.startswith("it")})
    return RPMNetFlags(iterations=iterations, test_iterations=iterations)


def batch(inputs: Arrays) -> Batch:
    """Split points and normals."""
    source, target = jnp.asarray(inputs["points_src"]), jnp.asarray(inputs["points_ref"])
    pose = RigidTransform(R=inputs["R_gt"], t=inputs["t_gt"])
    return Batch(source[..., :3], target[..., :3], None, pose, source[..., 3:], target[..., 3:])


def results(outcome: Outcome) -> Arrays:
    """Name the results; the recorded terms of the loss are without the discount."""
    found, iterations = dict(outcome.stages), outcome.prediction.iterations
    for i, x in enumerate(iterations):
        values = {"xyz_src_t": x.source, "beta": x.beta, "alpha": x.alpha, "affinity": x.affinity, "match": x.match}
        values |= {"row_sum": np.sum(x.match, axis=-1), "weighted_ref": x.partner, "R": x.pose.R, "t": x.pose.t}
        found |= {f"it{i}/{name}": value for name, value in values.items()}
    discount = RPMNetFlags().discount
    for name, value in outcome.terms.items():
        found[f"loss_terms/{name}"] = value / discount ** (len(iterations) - 1 - int(name.rpartition("_")[2]))
    heads = {f"{name}/head": value[:, :8] for name, value in found.items() if np.ndim(value) > 2}  # the first 8 points
    return found | heads | {"R": outcome.prediction.target_from_source.R, "t": outcome.prediction.target_from_source.t}


RPMNET = Method(
    name="rpmnet",
    network="rpmnet",
    flags_of_case=flags_of_case,
    flags_of_state=flags_of_state,
    layout=layout,
    inputs=POINTS,
    batch=batch,
    stages={
        "RPMNet.neighbourhoods": lambda i: [f"{name}_{('src', 'ref')[i]}" for name in ("group_idx", "dxyz", "ppf")],
        "RPMNet.encode": lambda i: [f"feat_src/{i - 1}" if i else "feat_ref"],
        "ParameterNet.pool": lambda i: [f"it{i}/pooled"],
        "ParameterNet.raw": lambda i: [f"it{i}/raw"],
    },
    results=results,
    overrides=lambda case: {"weights_net.postpool.6.bias": ("=", BIAS_OF_CASES)},
)
