"""The tensors of layers that networks share: their PyTorch names, and where they stand in the Flax variables."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from typing import Literal

from cmig_jax.parity.cases import State
from cmig_jax.parity.weights import COUNTER, RUNNING, Tensor


def linear(name: str, shape: tuple[int, ...], path: str | None, bias: bool = True, spatial: bool = False) -> Iterator[Tensor]:
    """List a convolution or a linear layer, `shape [out, in, ...]`, whose Flax module is at `path` (`a/b`); None has no place."""
    own = path and ("params", *path.split("/"))
    yield Tensor(f"{name}.weight", shape, (*own, "kernel") if own else None, spatial)
    if bias:
        yield Tensor(f"{name}.bias", shape[:1], (*own, "bias") if own else None)


def normalisation(name: str, channels: int, path: str | None, running: bool = True) -> Iterator[Tensor]:
    """List a normalisation: scale, bias, and with `running` its running statistics and their counter."""
    leaves = (("weight", "params", "scale"), ("bias", "params", "bias"))
    if running:
        leaves = (*leaves, (RUNNING[0], "batch_stats", "mean"), (RUNNING[1], "batch_stats", "var"))
    for leaf, kind, other in leaves:
        yield Tensor(f"{name}.{leaf}", (channels,), (kind, *path.split("/"), other) if path else None)
    if running:
        yield Tensor(f"{name}.{COUNTER}", ())


def stack(name: str, sizes: tuple[int, ...], unit: tuple[int, ...], paths: list[tuple[str | None, str | None]]) -> Iterator[Tensor]:
    """List 1x1 convolutions `sizes[0] -> sizes[1] -> ...` without bias, each with its BatchNorm, and a last one with bias alone."""
    for i, ((inputs, width), (layer, norm)) in enumerate(zip(itertools.pairwise(sizes[:-1]), paths, strict=False)):
        yield from linear(f"{name}.conv.{i}.conv", (width, inputs, *unit), layer, bias=False)
        yield from normalisation(f"{name}.conv.{i}.bn", width, norm)
    yield from linear(f"{name}.conv.{len(sizes) - 2}", (sizes[-1], sizes[-2], *unit), paths[-1][0])


def transformer(name: str, path: str, dim: int, hidden: int) -> Iterator[Tensor]:
    """List the tensors of `nn.attention.PairTransformer` at `path`, of `dim` channels and a feed-forward layer of `hidden`."""
    for half, attentions in (("encoder", ("self_attn",)), ("decoder", ("self_attn", "src_attn"))):
        layer, own = f"{name}.{half}.layers.0", f"{path}/{half}"
        for attention, module in zip(attentions, (f"{own}_attention", f"{own}_cross"), strict=False):
            for i, role in enumerate(("query", "key", "value", "out")):
                yield from linear(f"{layer}.{attention}.linears.{i}", (dim, dim), f"{module}/{role}")
        yield from linear(f"{layer}.feed_forward.w_1", (hidden, dim), f"{own}_feed_forward/layer_0")
        yield from linear(f"{layer}.feed_forward.w_2", (dim, hidden), f"{own}_feed_forward/layer_1")
        for i, norm in enumerate([*(f"{layer}.sublayer.{i}.norm" for i in range(len(attentions) + 1)), f"{name}.{half}.norm"]):
            for leaf, other in (("a_2", "scale"), ("b_2", "bias")):
                yield Tensor(f"{norm}.{leaf}", (dim,), ("params", *path.split("/"), f"{half}_norms_{i}", other))


def pointnet_path(kind: Literal["layer", "norm"], i: int, widths: tuple[int, ...]) -> str:
    """Return where layer i of the `PointNet` named `encoder` stands, or its normalisation."""
    return f"encoder/layers/{kind}_{i}" if i + 1 < len(widths) else f"encoder/last{'' if kind == 'layer' else '_norm'}"


def widths_of(state: State, name: str) -> tuple[int, ...]:
    """Return the output channels of the layers `name`, with `{}` for their number.

    Raises:
        ValueError: there is none.
    """
    form = re.compile(re.escape(name).replace(r"\{\}", r"(\d+)") + r"\.weight")
    found = {int(match[1]): len(state[key]) for key in state if (match := form.fullmatch(key))}
    if not found:
        raise ValueError(f"this state has no {name.format('*')}.weight")
    return tuple(found[number] for number in sorted(found))
