"""The state of the released CMIGNet: names, shapes and order of its tensors, and where each stands in the Flax variables."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from cmig_jax.models.cmignet.flags import CMIGNetFlags, ImageFlags, MatchingFlags, PointsFlags, released
from cmig_jax.models.cmignet.heads import CREDIBILITY_WIDTH
from cmig_jax.parity.cases import State
from cmig_jax.parity.layers import linear, normalisation, stack, transformer
from cmig_jax.parity.weights import Tensor, named_weights, to_flax

UNUSED = ("significance_fc.", "MVCNN.fc.", "head.")
IMAGE_CLASSES = 40


def layout(flags: CMIGNetFlags) -> list[Tensor]:
    """List the tensors of a network of the released kind, in the order of its `state_dict`."""
    return [
        *_points(flags),
        *_significance(flags),
        *_heads(flags),
        *_images(flags),
        *transformer("attn.model", "transformer", flags.points.dim, flags.fusion.feed_forward),
        *_score(flags),
    ]


def named_variables(flags: CMIGNetFlags, seed: int) -> dict[str, Any]:
    """Return `params` and `batch_stats` of the weights that a recorded case's seed names, as NumPy float64 arrays."""
    tensors = layout(flags)
    return to_flax(named_weights(tensors, seed), tensors)[0]


def small() -> CMIGNetFlags:
    """Return the flags of a network of the released kind that runs in seconds."""
    base = released()
    return replace(
        base,
        points=PointsFlags(k=6, widths=(8, 16), dim=32),
        image=ImageFlags(widths=(8, 32), blocks=(2, 1)),
        fusion=replace(base.fusion, heads=2, feed_forward=48),
        keypoints=replace(base.keypoints, count=24),
        matching=MatchingFlags(iterations=2, feature_widths=(16, 8), coordinate_widths=(8,)),
    )


def with_margins(flags: CMIGNetFlags, margins: tuple[float, float] | None) -> CMIGNetFlags:
    """Turn the overlap loss on with some margins (positive, negative); with None turn it off, as in the released scripts."""
    return replace(flags, loss=replace(flags.loss, overlap=margins is not None, margins=margins or flags.loss.margins))


def flags_of_state(state: State) -> CMIGNetFlags:
    """Read the sizes of a network off the shapes of its state; neighbours k, keypoints K and attention heads leave no trace there.

    Raises:
        ValueError: this cannot be the state of such a network.
    """

    def widths(pattern: str, first: int = 0) -> tuple[int, ...]:
        """Return the output channels of the tensors that `pattern` names, counted up from `first`."""
        names = itertools.takewhile(lambda name: name in state and state[name].ndim, map(pattern.format, itertools.count(first)))
        if not (found := tuple(state[name].shape[0] for name in names)):
            raise ValueError(f"this state is not the released network's: missing {pattern.format(first)}")
        return found

    base, points, images = released(), widths("emb_nn.conv{}.weight", 1), widths("MVCNN.net.{}.0.conv1.weight", 4)
    blocks = tuple(len(widths(f"MVCNN.net.{4 + stage}.{{}}.conv1.weight")) for stage in range(len(images)))
    return replace(
        base,
        points=replace(base.points, widths=points[:-1], dim=points[-1]),
        image=ImageFlags(widths=images, blocks=blocks),
        fusion=replace(base.fusion, feed_forward=widths("attn.model.encoder.layers.0.feed_forward.w_{}.weight", 1)[0]),
        matching=MatchingFlags(
            iterations=len(widths("preweight.{}.conv.0.weight")),
            feature_widths=widths("sim_mat_Fconv.0.conv.{}.conv.weight"),
            coordinate_widths=widths("sim_mat_Sconv.0.conv.{}.conv.weight"),
        ),
    )


def _points(flags: CMIGNetFlags) -> Iterator[Tensor]:
    *edges, (last, linked) = zip(
        (*flags.points.widths, flags.points.dim), itertools.accumulate(flags.points.widths, initial=3), strict=True
    )
    for i, (width, inputs) in enumerate(edges):
        yield from linear(f"emb_nn.conv{i + 1}", (width, 2 * inputs, 1, 1), f"points/edge_{i}", bias=False)
    yield from linear(f"emb_nn.conv{len(edges) + 1}", (last, linked, 1, 1), "points/last", bias=False)
    for i, (width, _) in enumerate(edges):
        yield from normalisation(f"emb_nn.bn{i + 1}", width, f"points/edge_{i}/norm")
    yield from normalisation(f"emb_nn.bn{len(edges) + 1}", last, "points/last_norm")


def _significance(flags: CMIGNetFlags) -> Iterator[Tensor]:
    """List what the released network has and never uses, and the constant of its pose solver."""
    yield from stack("significance_fc", (*(flags.points.dim // 2**i for i in range(5)), 1), (1,), [(None, None)] * 5)
    yield Tensor("head.reflect", (3, 3))


def _heads(flags: CMIGNetFlags) -> Iterator[Tensor]:
    matching, heads, C = flags.matching, range(flags.matching.iterations), CREDIBILITY_WIDTH
    towers = [("sim_mat_Fconv", "feature", flags.points.dim + 1, matching.feature_widths)]
    for name, part, inputs, widths in (*towers, ("sim_mat_Sconv", "coordinate", 7, matching.coordinate_widths)):
        for i in heads:
            tower = f"heads_{i}/{part}_tower"
            hidden = [(f"{tower}/hidden/layer_{j}", f"{tower}/hidden/norm_{j}") for j in range(len(widths) - 1)]
            paths = [(f"heads_{i}/{part}_pairs", f"{tower}/first_norm"), *hidden, (f"{tower}/last", None)]
            yield from stack(f"{name}.{i}", (inputs, *widths, 1), (1, 1), paths)
    for i in heads:
        own = f"heads_{i}/credibility"
        yield from stack(f"weight_fc.{i}", (C, C, 1), (1,), [(f"{own}/hidden/layer_0", f"{own}/hidden/norm_0"), (f"{own}/last", None)])
    for i in heads:
        yield from linear(f"preweight.{i}.conv.0", (C, 2, 1, 1), f"heads_{i}/pre")


def _images(flags: CMIGNetFlags) -> Iterator[Tensor]:
    def convolution(layer: str, norm: str, shape: tuple[int, int], size: int, path: str, norm_path: str) -> Iterator[Tensor]:
        yield from linear(layer, (*shape, size, size), path, bias=False, spatial=True)
        yield from normalisation(norm, shape[0], norm_path)

    inputs, *_ = widths = flags.image.widths
    yield from convolution("MVCNN.net.0", "MVCNN.net.1", (inputs, 3), 7, "views/stem", "views/stem_norm")
    for stage, (width, blocks) in enumerate(zip(widths, flags.image.blocks, strict=True)):
        for b in range(blocks):
            name, path = f"MVCNN.net.{4 + stage}.{b}", f"views/stage_{stage}_block_{b}"
            for i, shape in enumerate(((width, inputs), (width, width))):
                yield from convolution(f"{name}.conv{i + 1}", f"{name}.bn{i + 1}", shape, 3, f"{path}/conv_{i}", f"{path}/norm_{i}")
            if (stage > 0 and b == 0) or inputs != width:
                names, paths = (f"{name}.downsample.0", f"{name}.downsample.1"), (f"{path}/shortcut", f"{path}/shortcut_norm")
                yield from convolution(*names, (width, inputs), 1, *paths)
            inputs = width
    yield from linear("MVCNN.fc.0", (IMAGE_CLASSES, widths[-1]), None)


def _score(flags: CMIGNetFlags) -> Iterator[Tensor]:
    dim = flags.points.dim
    for i, (inputs, width) in enumerate(itertools.pairwise((2 * dim, dim, dim // 2, dim // 4, 1))):
        yield from linear(f"h3.{2 * i}", (width, inputs, 1), f"score/rest/layer_{i - 1}" if i else "score")
