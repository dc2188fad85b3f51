"""Pictures of pairs before and after registration, and of depth views: NumPy in, PNG (or any suffix matplotlib knows) out.

Figures are built as objects on the Agg canvas: no display and no global state, so that threads and tests do not disturb each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from numpy.typing import ArrayLike

from cmig_jax.files import replacing_path
from cmig_jax.report.colours import CORRECT, FAINT, INK, SOURCE, TARGET, WRONG

DPI = 150
DEPTH = ("#d3e0e9", "#7fa6c1", "#346a90", "#0f2c44")
MAX_LINES = 40


def plot_pairs(pairs: Sequence[Mapping[str, Any]], path: Path, *, up: Literal["x", "y", "z"] = "z") -> None:
    """Draw pairs before registration (above) and after (below).

    Args:
        pairs: each with `source` `[N, 3]`, `target` `[M, 3]` and the estimated `R` `[3, 3]`, `t` `[3]`; optionally `title`, and
            matched keypoints `source_keypoints` `[K, 3]` and `target_keypoints` `[K, 3]` with `correct` `[K]` bool. Where there are more
            than 40 matches, 40 of them are drawn.
        path: the picture.
        up: axis of the data that points upward.

    Raises:
        ValueError: no pair.
    """
    if not pairs:
        raise ValueError("pairs: expected at least one")
    rows = math.ceil(len(pairs) / 4)
    columns = math.ceil(len(pairs) / rows)
    figure = Figure(figsize=(2.9 * columns + 0.3, 5.4 * rows + 0.4))
    grid = figure.subplots(2 * rows, columns, squeeze=False, subplot_kw={"projection": "3d"})
    width, height = figure.get_size_inches()
    figure.subplots_adjust(left=0.3 / width, right=1, bottom=0.35 / height, top=1 - 0.3 / height, wspace=0, hspace=0.06)
    for axes in grid.flat:
        axes.set_axis_off()
    for i, pair in enumerate(pairs):
        row, column = divmod(i, columns)
        before, after = grid[2 * row, column], grid[2 * row + 1, column]
        _draw_pair(before, after, pair, up)
        before.set_title(str(pair.get("title", "")), fontsize=10, color=INK, pad=2, parse_math=False)
        if column == 0:
            for axes, label in ((before, "before"), (after, "after")):
                axes.text2D(-0.02, 0.5, label, transform=axes.transAxes, rotation=90, ha="right", va="center", color=INK, fontsize=10)
    _legend(figure, pairs)
    save(figure, path)


def plot_views(views: ArrayLike, path: Path, *, title: str = "") -> None:
    """Draw depth views as a contact sheet; near is dark, the background white.

    Args:
        views: `[V, H, W]` uint8, 0 = background, near is bright.
        path: the picture.
        title: a line above.

    Raises:
        ValueError: no view, or another shape.
    """
    views = np.asarray(views)
    if views.ndim != 3 or 0 in views.shape:
        raise ValueError(f"views of shape {views.shape}: expected [V, H, W], at least one view")
    columns = next((columns for columns in (7, 6, 5, 4) if len(views) % columns == 0), min(len(views), 6))
    rows = math.ceil(len(views) / columns)
    figure = Figure(figsize=(1.4 * columns, 1.55 * rows + (0.35 if title else 0)))
    margin = 0.08 / figure.get_figheight()
    figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02, rect=(0, margin, 1, 1 - 2 * margin))
    colours = LinearSegmentedColormap.from_list("depth", DEPTH).with_extremes(bad="white")
    grid = figure.subplots(rows, columns, squeeze=False)
    for i, axes in enumerate(grid.flat):
        axes.axis("off")
        if i < len(views):
            axes.imshow(np.ma.masked_equal(views[i], 0), cmap=colours, vmin=1, vmax=255, interpolation="nearest")
            axes.set_title(f"{i + 1}", fontsize=7, color=FAINT, pad=2)
    if title:
        figure.suptitle(title, fontsize=10, color=INK)
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Write a figure on white, in the format of the path's suffix."""
    FigureCanvasAgg(figure)
    with replacing_path(path) as temporary:
        figure.savefig(temporary, dpi=DPI, facecolor="white")


def style_axes(axes: Axes, xlabel: str, ylabel: str) -> None:
    """Label the axes, and draw a light frame and grid."""
    axes.set_xlabel(xlabel, color=INK, fontsize=9)
    axes.set_ylabel(ylabel, color=INK, fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(colors=INK, labelsize=8, which="both", color=FAINT)
    axes.grid(color=FAINT, alpha=0.25, lw=0.6)


def _draw_pair(before: Any, after: Any, pair: Mapping[str, Any], up: str) -> None:
    """Draw a pair into two 3D axes of the same limits, whose unit is the same along x, y and z."""
    source, target = np.asarray(pair["source"]), np.asarray(pair["target"])
    aligned = source @ np.asarray(pair["R"]).T + np.asarray(pair["t"])
    everything = np.concatenate([source, target, aligned])
    centre, radius = (everything.max(0) + everything.min(0)) / 2, np.ptp(everything, axis=0).max() / 2
    for axes, cloud, faint in ((before, source, 0.3 if "source_keypoints" in pair else 0.85), (after, aligned, 0.85)):
        for limits, middle in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), centre, strict=True):
            limits(middle - radius, middle + radius)
        axes.computed_zorder = False  # matches in front of the clouds
        axes.set_box_aspect((1, 1, 1), zoom=1.5)
        axes.view_init(elev=18, azim=-58, vertical_axis=up)
        # One collection in a fixed random order: neither cloud hides the other.
        points = np.concatenate([target, cloud])
        colours = np.repeat([TARGET, SOURCE], [len(target), len(cloud)])
        order = np.random.default_rng(0).permutation(len(points))
        axes.scatter(*points[order].T, s=4.5, c=colours[order], linewidths=0, alpha=faint, depthshade=False, clip_on=False, zorder=1)
    _draw_matches(before, pair)


def _draw_matches(axes: Any, pair: Mapping[str, Any]) -> None:
    if "source_keypoints" not in pair:
        return
    source, target = np.asarray(pair["source_keypoints"]), np.asarray(pair["target_keypoints"])
    colours = np.where(pair["correct"], CORRECT, WRONG)
    shown = np.linspace(0, len(source) - 1, min(len(source), MAX_LINES)).round().astype(int)
    segments = np.stack([source, target], 1)[shown]
    axes.add_collection3d(Line3DCollection(list(segments), colors=list(colours[shown]), linewidths=0.8, alpha=0.85, zorder=2))
    for points, colour in ((source, SOURCE), (target, TARGET)):
        axes.scatter(*points[shown].T, s=12, c=colour, edgecolors=INK, linewidths=0.5, depthshade=False, clip_on=False, zorder=3)


def _legend(figure: Figure, pairs: Sequence[Mapping[str, Any]]) -> None:
    entries: list[tuple[str, str, dict[str, Any]]] = [
        ("source", SOURCE, {"marker": "o", "ls": "none", "markersize": 5}),
        ("target", TARGET, {"marker": "o", "ls": "none", "markersize": 5}),
    ]
    if any("source_keypoints" in pair for pair in pairs):
        entries += [("right match", CORRECT, {}), ("wrong match", WRONG, {})]
    handles = [Line2D([], [], color=colour, label=label, **style) for label, colour, style in entries]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), frameon=False, fontsize=9, labelcolor=INK, borderaxespad=0.2)
