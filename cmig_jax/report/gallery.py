"""The pairs that a report shows: which ones, and their data in the page.

Coordinates are stored as 16-bit integers: a pair has one `scale`, the largest absolute coordinate over 32,767, so that rounding moves
a coordinate by at most half of it. Arrays are little-endian, row by row, in base64.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from cmig_jax.clouds import thinned
from cmig_jax.data.pairs import Pair
from cmig_jax.evaluation.errors import Errors
from cmig_jax.evaluation.matches import Matches
from cmig_jax.report.parts import encoded
from cmig_jax.report.plots import DEPTH

LARGEST = 32767
MAX_POINTS = 8192
"""Points of a cloud that the page holds; a larger one is thinned."""
# Pixels.
SHEET_WIDTH = 1200  # largest width of a contact sheet
VIEW_SIZE = 96  # largest size of a view in it
SHOWN_SIZE = 64  # smaller views are enlarged up to this size
GAP = 2  # between views


@dataclass(frozen=True)
class Example:
    """A pair of the report.

    Attributes:
        position: among the n pairs of the evaluation.
        rank: 0 for the largest rotation error of the network.
        pair: its arrays.
        matches: the network's, where it has any.
        name: of the object or of the recordings.
    """

    position: int
    rank: int
    pair: Pair
    matches: Matches | None
    name: str


def choose(rotation_deg: ArrayLike, count: int) -> list[tuple[int, int]]:
    """Choose pairs, worst first: half of them the very worst, the others evenly down to the median and on to the best.

    Args:
        rotation_deg: `[n]` the network's rotation errors.
        count: how many to choose; all where there are not more.

    Returns:
        (position, rank) of each; rank 0 is the largest error.

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"report_pairs = {count}: expected at least 1 pair")
    order = np.argsort(-np.asarray(rotation_deg), kind="stable")
    last = len(order) - 1
    if last < count:
        ranks = np.arange(last + 1)
    else:
        worst = (count + 1) // 2
        down = np.linspace(worst - 1, last, count - worst + 1)[1:].round().astype(int)
        if len(down) > 1 and worst <= last // 2:
            down[np.argmin(np.abs(down[:-1] - last // 2))] = last // 2  # the median itself
        ranks = np.concatenate([np.arange(worst), down])
    return [(int(order[rank]), int(rank)) for rank in ranks]


def describe(example: Example, errors: Errors) -> dict[str, Any]:
    """Return what the viewer needs of a pair, as JSON: clouds, keypoints, and every method's pose (`R` row by row, then `t`)."""
    pair, matched = example.pair, example.matches
    scale = max(float(np.abs(pair[cloud]).max()) for cloud in ("source", "target")) / LARGEST or 1.0
    described: dict[str, Any] = {"scale": scale}
    described |= {cloud: quantise(thinned(pair[cloud], MAX_POINTS), scale) for cloud in ("source", "target")}
    if matched is not None:
        described["matches"] = {
            "source": quantise(matched.source, scale),
            "target": quantise(matched.target, scale),
            "chosen": matched.chosen.tolist(),
            "used": matched.used.astype(int).tolist(),
            "right": matched.right.astype(int).tolist(),
        }
    i = example.position
    described["truth"] = _pose(errors.R[i], errors.t[i])
    described["poses"] = {name: _pose(found.R[i], found.t[i]) for name, found in errors.methods.items()}
    return described


def quantise(points: ArrayLike, scale: float) -> str:
    """Return points `[P, 3]` as base64 of int16 multiples of `scale`."""
    return encoded((np.asarray(points, np.float64) / scale).round().astype("<i2"))


def contact_sheet(views: NDArray[np.uint8]) -> tuple[bytes, int]:
    """Draw depth views side by side; near is dark, the background white.

    Args:
        views: `[V, H, W]` uint8, 0 = background, near is bright.

    Returns:
        A PNG, and the width to show it at, pixels.
    """
    step = -(-max(views.shape[1:]) // VIEW_SIZE)
    views = views[:, ::step, ::step]
    count, height, width = views.shape
    rows = -(-count // max(1, SHEET_WIDTH // (width + GAP)))
    columns = -(-count // rows)
    sheet = np.zeros((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP), np.uint8)
    for i, view in enumerate(views):
        row, column = divmod(i, columns)
        sheet[row * (height + GAP) :, column * (width + GAP) :][:height, :width] = view
    image = Image.fromarray(sheet, mode="P")
    image.putpalette(_palette())
    buffer = io.BytesIO()
    image.save(buffer, format="PNG", optimize=True)
    return buffer.getvalue(), image.width * max(1, SHOWN_SIZE // width)


def _palette() -> list[int]:
    """Return the colours of the depths 0 to 255, as `plots.plot_views` draws them."""
    depths = LinearSegmentedColormap.from_list("depth", DEPTH)(np.linspace(0, 1, 255))[:, :3]
    return (np.concatenate([[to_rgb("white")], depths]) * 255).round().astype(int).ravel().tolist()


def _pose(R: NDArray[np.float64], t: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 6) for value in [*R.ravel(), *t]]
