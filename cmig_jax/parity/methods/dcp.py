"""The recorded cases of DCP v1 and v2."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal

import numpy as np

from cmig_jax.models.dcp.network import CYCLE_WEIGHT, DCPFlags
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, normalisation, transformer
from cmig_jax.parity.method import Method, Outcome, channels_second, pair_batch_channels_second
from cmig_jax.parity.weights import Tensor

Pointer = Literal["transformer", "identity"]
INPUTS = {"src": "B 3 N", "tgt": "B 3 M", "R_gt": "B 3 3", "t_gt": "B 3"}


def edge_encoder(widths: tuple[int, ...], dim: int, edge: str, norm: str, inputs: tuple[int, ...]) -> Iterator[Tensor]:
    """List `emb_nn`: layers on edges of `inputs` channels at the paths `edge`, `norm` (with `{}` for their number), and the last one."""
    for i, (before, width) in enumerate(zip(inputs, widths, strict=True)):
        yield from linear(f"emb_nn.conv{i + 1}", (width, before, 1, 1), edge.format(i), bias=False)
    yield from linear(f"emb_nn.conv{len(widths) + 1}", (dim, sum(widths), 1, 1), "encoder/last", bias=False)
    for i, width in enumerate(widths):
        yield from normalisation(f"emb_nn.bn{i + 1}", width, norm.format(i))
    yield from normalisation(f"emb_nn.bn{len(widths) + 1}", dim, "encoder/last_norm")


def encoder_widths(state: State) -> tuple[int, ...]:
    """Return the channels of the layers of `emb_nn`, the last one too.

    Raises:
        ValueError: it has no such layers.
    """
    found = []
    while (name := f"emb_nn.conv{len(found) + 1}.weight") in state:
        found.append(state[name].shape[0])
    if len(found) < 2:
        raise ValueError("this state has no emb_nn.conv1.weight, emb_nn.conv2.weight")
    return tuple(found)


def _layout(flags: DCPFlags) -> list[Tensor]:
    parts = edge_encoder(flags.widths, flags.dim, "encoder/edges_{}", "encoder/norms_{}", (6, *flags.widths[:-1]))
    pointer = transformer("pointer.model", "transformer", flags.dim, flags.feed_forward) if flags.pointer == "transformer" else ()
    return [*parts, *pointer, Tensor("head.reflect", (3, 3))]


def _of_case(pointer: Pointer) -> Callable[[Case], DCPFlags]:
    def flags(case: Case) -> DCPFlags:
        cycle = "official" if "loss_terms/cycle_rotation" in case.outputs else "off"
        return DCPFlags(k=case.outputs["knn_src"].shape[-1], pointer=pointer, cycle=cycle)

    return flags


def _of_state(pointer: Pointer) -> Callable[[State], DCPFlags]:
    def flags(state: State) -> DCPFlags:
        name, (*widths, dim) = "pointer.model.encoder.layers.0.feed_forward.w_1.weight", encoder_widths(state)
        if (name in state) != (pointer == "transformer"):
            raise ValueError(f"this state {'has' if name in state else 'has no'} pointer.model, unlike DCP with pointer = {pointer}")
        hidden = state[name].shape[0] if name in state else DCPFlags.feed_forward
        return DCPFlags(widths=tuple(widths), dim=dim, pointer=pointer, feed_forward=hidden)

    return flags


def _results(outcome: Outcome) -> Arrays:
    found = {name: channels_second(value) for name, value in outcome.stages.items() if value.ndim == 3 and not name.startswith("knn")}
    found |= {name: np.sort(value, axis=-1) for name, value in outcome.stages.items() if name.startswith("knn")}
    found["scores"] = outcome.stages["scores"]
    pose, back, partners = (getattr(outcome.prediction, name) for name in ("target_from_source", "source_from_target", "partners"))
    found |= {"R": pose.R, "t": pose.t, "R_ba": back.R, "t_ba": back.t, "src_corr": channels_second(partners)}
    found["H"] = np.einsum("bin,bnj->bij", outcome.inputs["src"], partners - partners.mean(1, keepdims=True))
    weights = {name: CYCLE_WEIGHT if name.startswith("cycle") else 1 for name in outcome.terms}  # recorded before they are weighted
    return found | {f"loss_terms/{name}": np.asarray(value / weights[name]) for name, value in outcome.terms.items()}


def _method(name: str, pointer: Pointer) -> Method:
    clouds = ("src", "tgt")
    return Method(
        name=name,
        network=DCPFlags.network,
        flags_of_case=_of_case(pointer),
        flags_of_state=_of_state(pointer),
        layout=_layout,
        inputs=INPUTS,
        batch=pair_batch_channels_second,
        stages={
            "StaticEdgeEncoder.graph": lambda i: [f"knn_{clouds[i]}"],
            "StaticEdgeEncoder.pooled": lambda i: [f"layer{j + 1}_{clouds[i]}" for j in range(len(DCPFlags.widths))],
            "StaticEdgeEncoder.__call__": lambda i: [f"feat_{clouds[i]}"],
            "PairTransformer.__call__": lambda i: [f"pointer_{clouds[i]}"],
            "DCPNetwork.embed": lambda _: ["emb_src", "emb_tgt"],
            "DCPNetwork.point": lambda i: [("scores", "scores_ba")[i]],
        },
        results=_results,
    )


DCP_V1, DCP_V2 = _method("dcp_v1", "identity"), _method("dcp_v2", "transformer")
