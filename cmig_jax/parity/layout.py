"""Where each tensor of the released PyTorch network stands in the Flax variables, and how its axes are ordered there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cmig_jax.parity.sizes import Sizes

Kind = Literal["linear", "conv1", "conv2", "image", "norm", "layer-norm"]


@dataclass(frozen=True)
class Place:
    """One tensor: its PyTorch name, its path in the Flax variables, and the kind of module that owns it."""

    name: str
    path: tuple[str, ...]
    kind: Kind

    def to_flax(self, value: NDArray) -> NDArray:
        """Reorder from PyTorch `[out, in, ...]` to Flax `[..., in, out]`; 1x1 kernels lose their unit axes."""
        if self.path[-1] != "kernel":
            return value
        if self.kind == "image":
            return np.ascontiguousarray(value.transpose(2, 3, 1, 0))
        return np.ascontiguousarray(value.reshape(value.shape[:2]).T)

    def to_torch(self, value: NDArray) -> NDArray:
        """Undo `to_flax`."""
        if self.path[-1] != "kernel":
            return value
        if self.kind == "image":
            return np.ascontiguousarray(value.transpose(3, 2, 0, 1))
        units = {"linear": 0, "conv1": 1, "conv2": 2}[self.kind]
        return np.ascontiguousarray(value.T).reshape(*value.T.shape, *(1,) * units)


def places(sizes: Sizes) -> list[Place]:
    """List every tensor that both networks have."""
    modules = [*_points(sizes), *_views(sizes), *_transformer(), *_score()]
    for i in range(sizes.iterations):
        modules += _head(i, sizes)
    return [place for flax, torch, kind, bias in modules for place in _tensors(flax, torch, kind, bias)]


Module = tuple[str, str, Kind, bool]  # Flax path, PyTorch path, kind, whether it has a bias


def _tensors(flax: str, torch: str, kind: Kind, bias: bool) -> Iterator[Place]:
    path = tuple(flax.split("/"))
    if kind == "layer-norm":
        leaves = [("params", "scale", "a_2"), ("params", "bias", "b_2")]
    elif kind == "norm":
        leaves = [("params", "scale", "weight"), ("params", "bias", "bias")]
        leaves += [("batch_stats", "mean", "running_mean"), ("batch_stats", "var", "running_var")]
    else:
        leaves = [("params", "kernel", "weight"), ("params", "bias", "bias")][: 1 + bias]
    for collection, leaf, name in leaves:
        yield Place(f"{torch}.{name}", (collection, *path, leaf), kind)


def _points(sizes: Sizes) -> Iterator[Module]:
    for i in range(len(sizes.widths)):
        yield f"points/edge_{i}", f"emb_nn.conv{i + 1}", "conv2", False
        yield f"points/edge_{i}/norm", f"emb_nn.bn{i + 1}", "norm", True
    yield "points/last", f"emb_nn.conv{len(sizes.widths) + 1}", "conv2", False
    yield "points/last_norm", f"emb_nn.bn{len(sizes.widths) + 1}", "norm", True


def _views(sizes: Sizes) -> Iterator[Module]:
    yield "views/stem", "MVCNN.net.0", "image", False
    yield "views/stem_norm", "MVCNN.net.1", "norm", True
    for stage, count in enumerate(sizes.image_blocks):
        for b in range(count):
            flax, torch = f"views/stage_{stage}_block_{b}", f"MVCNN.net.{4 + stage}.{b}"
            for c in range(2):
                yield f"{flax}/conv_{c}", f"{torch}.conv{c + 1}", "image", False
                yield f"{flax}/norm_{c}", f"{torch}.bn{c + 1}", "norm", True
            if stage > 0 and b == 0:
                yield f"{flax}/shortcut", f"{torch}.downsample.0", "image", False
                yield f"{flax}/shortcut_norm", f"{torch}.downsample.1", "norm", True


def _transformer() -> Iterator[Module]:
    attentions = [("encoder_attention", "encoder.layers.0.self_attn")]
    attentions += [("decoder_attention", "decoder.layers.0.self_attn"), ("decoder_cross", "decoder.layers.0.src_attn")]
    for flax, torch in attentions:
        for i, role in enumerate(("query", "key", "value", "out")):
            yield f"transformer/{flax}/{role}", f"attn.model.{torch}.linears.{i}", "linear", True
    for half, sublayers in (("encoder", 2), ("decoder", 3)):
        for i in range(2):
            yield f"transformer/{half}_feed_forward/layer_{i}", f"attn.model.{half}.layers.0.feed_forward.w_{i + 1}", "linear", True
        for i in range(sublayers):
            yield f"transformer/{half}_norms_{i}", f"attn.model.{half}.layers.0.sublayer.{i}.norm", "layer-norm", True
        yield f"transformer/{half}_norms_{sublayers}", f"attn.model.{half}.norm", "layer-norm", True


def _score() -> Iterator[Module]:
    yield "score", "h3.0", "conv1", True
    for i in range(3):
        yield f"score/rest/layer_{i}", f"h3.{2 * i + 2}", "conv1", True


def _head(i: int, sizes: Sizes) -> Iterator[Module]:
    head = f"heads_{i}"
    towers: list[tuple[str, str, tuple[int, ...]]] = [("feature", "sim_mat_Fconv", sizes.feature_widths)]
    towers += [("coordinate", "sim_mat_Sconv", sizes.coordinate_widths)]
    for name, torch, widths in towers:
        yield f"{head}/{name}_pairs", f"{torch}.{i}.conv.0.conv", "conv2", False
        yield f"{head}/{name}_tower/first_norm", f"{torch}.{i}.conv.0.bn", "norm", True
        for j in range(1, len(widths)):
            yield f"{head}/{name}_tower/hidden/layer_{j - 1}", f"{torch}.{i}.conv.{j}.conv", "conv2", False
            yield f"{head}/{name}_tower/hidden/norm_{j - 1}", f"{torch}.{i}.conv.{j}.bn", "norm", True
        yield f"{head}/{name}_tower/last", f"{torch}.{i}.conv.{len(widths)}", "conv2", True
    yield f"{head}/pre", f"preweight.{i}.conv.0", "conv2", True
    yield f"{head}/credibility/hidden/layer_0", f"weight_fc.{i}.conv.0.conv", "conv1", False
    yield f"{head}/credibility/hidden/norm_0", f"weight_fc.{i}.conv.0.bn", "norm", True
    yield f"{head}/credibility/last", f"weight_fc.{i}.conv.1", "conv1", True
