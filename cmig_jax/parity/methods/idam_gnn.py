"""The recorded cases of IDAM with its graph network."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cmig_jax.models.cmignet.prediction import Iteration
from cmig_jax.models.idam.flags import IDAMFlags
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, normalisation
from cmig_jax.parity.method import Method, Outcome, channels_second, is_training, pair_batch_channels_second
from cmig_jax.parity.methods.dcp import INPUTS
from cmig_jax.parity.weights import Tensor

CLOUDS = ("tgt", "src")  # the order of the graph network's calls
GEOMETRY = 8.0  # the four channels of distance and direction weigh more in the cases, so that they matter
STAGES = {
    "GraphLayer.__call__": lambda i: [f"gnn{i % IDAMFlags.layers + 1}_{CLOUDS[i // IDAMFlags.layers]}"],
    "Significance.__call__": lambda i: [("score_src", "score_tgt")[i]],
    "IDAMNetwork.correspondents": lambda _: ["tgt_nearest", "labels"],
    "Matcher.pairs": lambda i: [f"it{i}/pair_feature"],
    "Matcher.best": lambda i: [f"it{i}/weight_in"],
    "Matcher.__call__": lambda i: [f"it{i}/match_raw", f"it{i}/logit"],
}


def _layout(flags: IDAMFlags) -> list[Tensor]:
    return [*_graph(flags), *_significance(flags), *_matching(flags), Tensor("head.reflect", (3, 3))]


def _graph(flags: IDAMFlags) -> Iterator[Tensor]:
    C = flags.dim
    for i in range(flags.layers):
        name, path = f"emb_nn.propogate{i + 1}", f"graph_layers_{i}"
        yield from linear(f"{name}.conv2d.conv.0.conv", (C, C if i else 3, 1, 1), f"{path}/edge_first", bias=False)
        yield from normalisation(f"{name}.conv2d.conv.0.bn", C, f"{path}/edge_norm")
        yield from linear(f"{name}.conv2d.conv.1", (C, C, 1, 1), f"{path}/edge_last")
        yield from linear(f"{name}.conv1d.conv.0", (C, C, 1), f"{path}/point")


def _significance(flags: IDAMFlags) -> Iterator[Tensor]:
    inputs = flags.dim
    for i, width in enumerate(flags.significance_widths):
        yield from linear(f"significance_fc.conv.{i}.conv", (width, inputs, 1), f"significance/hidden/layer_{i}", bias=False)
        yield from normalisation(f"significance_fc.conv.{i}.bn", width, f"significance/hidden/norm_{i}")
        inputs = width
    yield from linear(f"significance_fc.conv.{len(flags.significance_widths)}", (1, inputs, 1), "significance/last")


def _matching(flags: IDAMFlags) -> Iterator[Tensor]:
    C, iterations = flags.pair_width, range(flags.iterations)
    for i in iterations:
        yield from linear(f"sim_mat_conv1.{i}.conv.0.conv", (C, 2 * flags.dim + 4, 1, 1), f"matchers_{i}/first", bias=False)
        yield from normalisation(f"sim_mat_conv1.{i}.conv.0.bn", C, f"matchers_{i}/first_norm")
        yield from linear(f"sim_mat_conv1.{i}.conv.1", (C, C, 1, 1), f"matchers_{i}/last")
    for name, path, unit in (("sim_mat_conv2", "match", (1, 1)), ("weight_fc", "logit", (1,))):
        for i in iterations:
            yield from linear(f"{name}.{i}.conv.0.conv", (C, C, *unit), f"matchers_{i}/{path}_hidden/layer_0", bias=False)
            yield from normalisation(f"{name}.{i}.conv.0.bn", C, f"matchers_{i}/{path}_hidden/norm_0")
            yield from linear(f"{name}.{i}.conv.1", (1, C, *unit), f"matchers_{i}/{path}_last")


def _of_case(case: Case) -> IDAMFlags:
    iterations = sum(f"it{i}/t" in case.outputs for i in range(16))
    return IDAMFlags(points_per_keypoint=case.inputs["src"].shape[-1] // int(case.outputs["K"]), iterations=iterations)


def _of_state(state: State) -> IDAMFlags:
    def count(pattern: str) -> int:
        return next(i for i in range(len(state) + 1) if pattern.format(i) not in state)

    layers = sum(name.startswith("emb_nn.propogate") and name.endswith("conv1d.conv.0.weight") for name in state)
    iterations, scores = count("sim_mat_conv1.{}.conv.1.weight"), count("significance_fc.conv.{}.conv.weight")
    if not (layers and iterations and scores):
        raise ValueError("this state has no emb_nn.propogate1, sim_mat_conv1.0 and significance_fc.conv.0")
    return IDAMFlags(
        layers=layers,
        dim=state["emb_nn.propogate1.conv1d.conv.0.weight"].shape[0],
        significance_widths=tuple(state[f"significance_fc.conv.{i}.conv.weight"].shape[0] for i in range(scores)),
        pair_width=state["sim_mat_conv1.0.conv.1.weight"].shape[0],
        iterations=iterations,
    )


def _draws(case: Case) -> Arrays:
    """Return the drawn keypoints of a training case."""
    return {"source_index": case.outputs["src_idx"].astype(np.int32)} if is_training(case) else {}


def _overrides(case: Case) -> dict[str, tuple[str, np.ndarray]]:
    flags = _of_case(case)
    scale = np.ones((1, 2 * flags.dim + 4, 1, 1))
    scale[:, 2 * flags.dim :] = GEOMETRY
    return {f"sim_mat_conv1.{i}.conv.0.conv.weight": ("*", scale) for i in range(flags.iterations)}


def _results(outcome: Outcome) -> Arrays:
    prediction = outcome.prediction
    found = {name: channels_second(x) if name.startswith("gnn") or name.endswith("weight_in") else x for name, x in outcome.stages.items()}
    for i, iteration in enumerate(prediction.iterations):
        features = np.moveaxis(found.pop(f"it{i}/pair_feature"), -1, 1)
        found |= {f"it{i}/pair_feature": features, f"it{i}/pair_feature/head": features[:, :, :8]}
        found |= _iteration(f"it{i}", iteration)
    chosen, pose = prediction.keypoints, prediction.target_from_source
    found |= {"src_idx": chosen.source_index, "tgt_idx": chosen.target_index, "R": pose.R, "t": pose.t}
    found |= {"K": np.asarray(chosen.source_index.shape[1])}
    if chosen.match_label is not None:
        found["match_labels"] = chosen.match_label
    found |= {f"it0/negent_{cloud}": _negative_entropy(prediction.iterations[0].match, axis) for cloud, axis in (("src", -1), ("tgt", -2))}
    return found | {f"loss_terms/{name}": np.asarray(value) for name, value in outcome.terms.items()}


def _iteration(name: str, iteration: Iteration) -> Arrays:
    values = {
        "corr_idx": iteration.correspondence,
        "svd_src": channels_second(np.asarray(iteration.source)),
        "svd_corr": channels_second(np.asarray(iteration.corresponding)),
        "svd_w": iteration.weight,
        "R": iteration.step.R,
        "t": iteration.step.t,
    }
    return {f"{name}/{key}": np.asarray(value) for key, value in values.items()}


def _negative_entropy(match: np.ndarray, axis: int) -> np.ndarray:
    log_p = match - np.log(np.sum(np.exp(match), axis=axis, keepdims=True))
    return np.sum(np.exp(log_p) * log_p, axis=axis)


IDAM_GNN = Method(
    name="idam_gnn",
    network=IDAMFlags.network,
    flags_of_case=_of_case,
    flags_of_state=_of_state,
    layout=_layout,
    inputs=INPUTS,
    batch=pair_batch_channels_second,
    stages=STAGES,
    results=_results,
    draws=_draws,
    overrides=_overrides,
    with_loss=False,
)
