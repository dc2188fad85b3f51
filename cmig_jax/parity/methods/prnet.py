"""The recorded cases of PRNet, with its Gumbel and its softmax matching."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cmig_jax.models.prnet.network import TEMPERATURE_WIDTHS, PRNetFlags
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, normalisation, transformer
from cmig_jax.parity.method import Method, Outcome, channels_second, pair_batch_channels_second
from cmig_jax.parity.methods.dcp import INPUTS, edge_encoder, encoder_widths
from cmig_jax.parity.weights import Tensor

MOST_ITERATIONS = 8
CLOUDS, WAYS = ("src", "tgt"), ("ab", "ba")
ORDERS = {f"it{i}/keypoints_{cloud}": "B K" for i in range(MOST_ITERATIONS) for cloud in CLOUDS}
NOISE = {f"it{i}/gumbel_{way}": "B K K" for i in range(MOST_ITERATIONS) for way in WAYS}


def _layout(flags: PRNetFlags) -> list[Tensor]:
    inputs = (6, *(2 * width for width in flags.widths[:-1]))
    return [
        *edge_encoder(flags.widths, flags.dim, "encoder/edge_{}", "encoder/edge_{}/norm", inputs),
        *transformer("attention.model", "transformer", flags.dim, flags.feed_forward),
        *_temperature(flags),
        Tensor("head.reflect", (3, 3)),
        Tensor("head.temperature", (1,)),
    ]


def _temperature(flags: PRNetFlags) -> Iterator[Tensor]:
    for i, (inputs, width) in enumerate(itertools.pairwise((flags.dim, *TEMPERATURE_WIDTHS))):
        yield from linear(f"temp_net.nn.{3 * i}", (width, inputs), f"temperature_hidden/layer_{i}")
        yield from normalisation(f"temp_net.nn.{3 * i + 1}", width, f"temperature_hidden/norm_{i}")
    yield from linear(f"temp_net.nn.{3 * len(TEMPERATURE_WIDTHS)}", (1, TEMPERATURE_WIDTHS[-1]), "temperature_last")


def _of_case(case: Case) -> PRNetFlags:
    iterations = sum(f"it{i}/R_ab" in case.outputs for i in range(MOST_ITERATIONS))
    matching = "gumbel" if "it0/gumbel_ab" in case.inputs else "softmax"
    return PRNetFlags(keypoints=case.inputs["it0/keypoints_src"].shape[1], matching=matching, iterations=iterations)


def _of_state(state: State) -> PRNetFlags:
    name, (*widths, dim) = "attention.model.encoder.layers.0.feed_forward.w_1.weight", encoder_widths(state)
    if name not in state:
        raise ValueError(f"this state is not PRNet's: missing {name}")
    return PRNetFlags(widths=tuple(widths), dim=dim, feed_forward=state[name].shape[0])


def _draws(case: Case) -> Arrays:
    """Return the noise and, since its rows and columns follow them, the order of the keypoints; nothing for the softmax."""
    inputs = case.inputs
    if "it0/gumbel_ab" not in inputs:
        return {}
    rounds = [i for i in range(MOST_ITERATIONS) if f"it{i}/gumbel_ab" in inputs]
    return {
        "noise": np.stack([[inputs[f"it{i}/gumbel_{way}"] for way in WAYS] for i in rounds]),
        "order": np.stack([[inputs[f"it{i}/keypoints_{cloud}"].astype(int) for cloud in CLOUDS] for i in rounds]),
    }


def _results(outcome: Outcome) -> Arrays:
    seen, found = outcome.stages, {}
    for i, iteration in enumerate(outcome.prediction.iterations):
        own = {}
        for name in ("feat", "emb"):
            own |= {f"{name}_{cloud}": channels_second(seen[f"it{i}/{name}_{cloud}"]) for cloud in CLOUDS}
        places = []
        for cloud in CLOUDS:
            score = own[f"score_{cloud}"] = seen[f"it{i}/score_{cloud}"]
            place = _places(seen[f"it{i}/keypoints_{cloud}"], outcome.inputs[f"it{i}/keypoints_{cloud}"], score)
            own[f"keyemb_{cloud}"] = channels_second(_take(seen[f"it{i}/keyemb_{cloud}"], place))
            places.append(place)
        of_source, of_target = places
        own["logits"] = np.swapaxes(_take(np.swapaxes(_take(seen[f"it{i}/logits"], of_source), 1, 2), of_target), 1, 2)
        own["src_corr"] = channels_second(_take(seen[f"it{i}/src_corr"], of_source))
        own["src_key"] = channels_second(_take(seen[f"it{i}/src_key"], of_source))
        own |= {"temperature": seen[f"it{i}/temperature"], "disparity": iteration.disparity}
        for way, pose in zip(WAYS, (iteration.step, iteration.back), strict=True):
            own |= {f"R_{way}": pose.R, f"t_{way}": pose.t}
        found |= {f"it{i}/{name}": value for name, value in own.items()}
    terms = {f"loss_terms/{name}": value for name, value in outcome.terms.items()}
    sums = {kind: sum(value for name, value in outcome.terms.items() if name.startswith(kind)) for kind in ("feature", "cycle")}
    totals = {f"loss_{kind}_total": np.asarray(value) for kind, value in sums.items()}
    pose = outcome.prediction.target_from_source
    return found | terms | totals | {"R": pose.R, "t": pose.t}


def _places(ours: NDArray, recorded: NDArray, score: NDArray) -> NDArray:
    """Return where each recorded keypoint `[B, K]` stands among ours.

    Raises:
        ValueError: the network's keypoints, or the points of the highest scores, are not the recorded ones.
    """
    best = np.argsort(-score, axis=1)[:, : recorded.shape[1]]
    if not all(np.array_equal(np.sort(x), np.sort(recorded)) for x in (ours, best)):
        raise ValueError("the points of the largest features are not the recorded keypoints")
    return np.take_along_axis(np.argsort(ours, axis=1), np.argsort(np.argsort(recorded, axis=1), axis=1), axis=1)


def _take(rows: NDArray, place: NDArray) -> NDArray:
    return np.take_along_axis(rows, place[..., None], axis=1)


def _per_cloud(name: str) -> list[list[str]]:
    return [[f"it{i}/{name}_{cloud}"] for i in range(MOST_ITERATIONS) for cloud in CLOUDS]


PRNET = Method(
    name="prnet",
    network=PRNetFlags.network,
    flags_of_case=_of_case,
    flags_of_state=_of_state,
    layout=_layout,
    inputs=INPUTS | ORDERS | NOISE,
    optional=(*ORDERS, *NOISE),
    batch=pair_batch_channels_second,
    stages={
        "PRNet.encode": lambda i: _per_cloud("feat")[i],
        "PRNet.embed": lambda i: [f"it{i}/emb_src", f"it{i}/emb_tgt"],
        "PRNet.score": lambda i: _per_cloud("score")[i],
        "PRNet.choose": lambda i: [
            f"it{i // 2}/{name}_{CLOUDS[i % 2]}" if name != "points" else f"it{i // 2}/{CLOUDS[i % 2]}_key"
            for name in ("keypoints", "points", "keyemb")
        ],
        "PRNet.temperature": lambda i: [f"it{i}/temperature"],
        "PRNet.match": lambda i: [f"it{i}/logits"],
        "PRNet.solve": lambda i: ["", "", f"it{i // 2}/{'src_corr' if i % 2 == 0 else 'tgt_corr'}"],
    },
    results=_results,
    draws=_draws,
    overrides=lambda _: {"temp_net.nn.9.bias": ("+", 2.0)},
)
