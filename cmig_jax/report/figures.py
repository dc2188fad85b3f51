"""Rotation errors by method: their distribution, and how they depend on overlap, true angle and category.

Every figure is written as PNG for papers and as SVG to stand inside a page, where its ink takes the page's colour.
Errors are isotropic rotation errors in degrees on a log axis; those below `FLOOR` are drawn there.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import ArrayLike, NDArray

from cmig_jax.evaluation.errors import Errors
from cmig_jax.evaluation.metrics import RECALL_DEG
from cmig_jax.report.colours import FAINT, INK
from cmig_jax.report.plots import save, style_axes

FLOOR, CEILING = 1e-3, 180.0
NETWORKS = ("#3179b5", "#d9772b", "#3f9b6c", "#cf5c9e")
OTHERS = ("#8a8a8a", "#a5764a", "#8e6bbf", "#2a9aa5", "#94892b", "#c94f5d", "#5f7f4f", "#7a86c8")
"""Colours that stand out from white and from black."""
BINS, FEWEST = 8, 5
"""Bins of pairs along the horizontal axis: the most bins, and the fewest pairs per bin."""


class Drawn(NamedTuple):
    """A figure of the report: its file's name, heading, what it shows, and the SVG."""

    name: str
    heading: str
    caption: str
    svg: str


def write_figures(folder: Path, errors: Errors) -> list[Drawn]:
    """Draw all figures: a PNG of each into a folder, and what a page needs of them.

    Args:
        folder: where `errors.png`, `error_vs_overlap.png`, `error_vs_angle.png` and `error_by_category.png` go.
        errors: of an evaluation.
    """
    against = "Medians over bins of about equally many pairs; the band spans the network's quartiles, the dots are its pairs."
    figures = [
        (
            "errors",
            "Rotation errors",
            f"Share of pairs whose error is at most that large (the dotted line marks the recall's {RECALL_DEG:g} degrees), and how "
            "the errors spread, with their median.",
            draw_distribution(errors),
        ),
        (
            "error_vs_overlap",
            "Error against overlap",
            against,
            draw_against(errors, 100 * errors.overlap, "overlap [%]"),
        ),
        (
            "error_vs_angle",
            "Error against the true rotation",
            against,
            draw_against(errors, errors.angle_deg, "angle of the true rotation [deg]"),
        ),
        (
            "error_by_category",
            "Error by category",
            "Median over the pairs of a category, whose number is in brackets; the network's largest first.",
            draw_categories(errors),
        ),
    ]
    drawn = []
    for name, heading, caption, figure in figures:
        save(figure, folder / f"{name}.png")
        drawn.append(Drawn(name, heading, caption, inline_svg(figure, name)))
    return drawn


def colours(errors: Errors) -> dict[str, str]:
    """Return a colour for each method; those that use the network have their own family."""
    left = {True: iter(NETWORKS * len(errors.methods)), False: iter(OTHERS * len(errors.methods))}
    return {name: next(left[_uses_network(name, errors)]) for name in errors.methods}


def draw_distribution(errors: Errors) -> Figure:
    """Draw the cumulative errors of every method, and beside them a histogram of each."""
    figure = Figure(figsize=(10, 0.9 + max(3.2, 0.42 * len(errors.methods))), layout="constrained")
    cumulative, histograms = figure.subplots(1, 2)
    shown = {name: np.clip(found.rotation_deg, FLOOR, CEILING) for name, found in errors.methods.items()}
    low = _lowest(shown.values())
    grid = np.geomspace(low, CEILING, 300)  # as fine as the picture, however many pairs there are
    for name, colour in colours(errors).items():
        share = np.searchsorted(np.sort(shown[name]), grid, side="right") / len(errors)
        cumulative.plot(grid, 100 * share, color=colour, label=name, **_line(name, errors))
    cumulative.axvline(RECALL_DEG, color=FAINT, lw=1, ls=":")
    cumulative.set_ylim(0, 101)
    _log_axis(cumulative.xaxis, cumulative.set_xlim, low)
    style_axes(cumulative, "rotation error [deg]", "pairs [%]")
    _plain(cumulative.legend(frameon=False, fontsize=8, labelcolor=INK, loc="best").get_texts())
    _draw_histograms(histograms, errors, shown, low)
    return figure


def draw_against(errors: Errors, x: ArrayLike, xlabel: str) -> Figure:
    """Draw the errors of every method against a number `x` `[n]` of each pair."""
    figure = Figure(figsize=(10, 4.1), layout="constrained")
    axes = figure.subplots()
    x = np.asarray(x, np.float64)
    shown = {name: np.clip(found.rotation_deg, FLOOR, CEILING) for name, found in errors.methods.items()}
    groups = _bins(x)
    middle = [np.median(x[group]) for group in groups]
    for name, colour in colours(errors).items():
        if name == errors.network:
            axes.scatter(x, shown[name], s=7, color=colour, alpha=0.45, linewidths=0, rasterized=True)
            low, high = np.array([np.quantile(shown[name][group], [0.25, 0.75]) for group in groups]).T
            axes.fill_between(middle, low, high, color=colour, alpha=0.15, linewidth=0)
        medians = [np.median(shown[name][group]) for group in groups]
        axes.plot(middle, medians, color=colour, label=name, marker="o", ms=4, **_line(name, errors))
    _log_axis(axes.yaxis, axes.set_ylim, _lowest(shown.values()))
    style_axes(axes, xlabel, "rotation error [deg]")
    _plain(axes.legend(frameon=False, fontsize=8, labelcolor=INK, loc="center left", bbox_to_anchor=(1, 0.5)).get_texts())
    return figure


def draw_categories(errors: Errors) -> Figure:
    """Draw the median error of every method in every category, the network's largest on top."""
    names, member = np.unique(np.array(errors.category), return_inverse=True)
    shown = {name: np.clip(found.rotation_deg, FLOOR, CEILING) for name, found in errors.methods.items()}
    medians = {name: np.array([np.median(v[member == i]) for i in range(len(names))]) for name, v in shown.items()}
    order = np.argsort(-medians[errors.network], kind="stable")
    figure = Figure(figsize=(10, 1.0 + max(1.2, 0.23 * len(names))), layout="constrained")
    axes = figure.subplots()
    rows = np.arange(len(names))
    axes.hlines(rows, FLOOR, CEILING, color=FAINT, alpha=0.25, lw=0.6)
    for name, colour in colours(errors).items():
        size = 42 if _uses_network(name, errors) else 22
        axes.scatter(medians[name][order], rows, s=size, color=colour, label=name, alpha=0.9, linewidths=0, zorder=3)
    labels = [f"{names[i] or 'without a category'} ({np.sum(member == i)})" for i in order]
    axes.set_yticks(rows, labels)
    _plain(axes.get_yticklabels())
    axes.set_ylim(len(names) - 0.4, -0.6)
    _log_axis(axes.xaxis, axes.set_xlim, _lowest(medians.values()))
    style_axes(axes, "median rotation error [deg]", "")
    axes.grid(visible=False, axis="y")
    _plain(axes.legend(frameon=False, fontsize=8, labelcolor=INK, loc="center left", bbox_to_anchor=(1, 0.5)).get_texts())
    return figure


def inline_svg(figure: Figure, name: str) -> str:
    """Return a figure as SVG for a page: text as text, ink in the page's colours, no name that another figure has, no address."""
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        nothing: dict[str, Any] = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(buffer, format="svg", transparent=True, metadata=nothing)
    svg = buffer.getvalue().decode()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", svg)
    svg = re.sub(r'(<svg [^>]*?)width="[^"]*"', r"\1", re.sub(r'(<svg [^>]*?)height="[^"]*"', r"\1", svg, count=1), count=1)
    return svg.replace(INK, "currentColor").replace(FAINT, "var(--faint)")


def _draw_histograms(axes: Axes, errors: Errors, shown: Mapping[str, NDArray[np.float64]], low: float) -> None:
    """Draw one histogram above the other, each to its own height: what matters is where a method's errors lie."""
    edges = np.geomspace(low, CEILING, 41)
    for row, (name, colour) in enumerate(colours(errors).items()):
        counts, _ = np.histogram(shown[name], edges)
        heights = 0.85 * counts / counts.max()
        axes.stairs(row - heights, edges, baseline=row, fill=True, color=colour, alpha=0.8)
        middle = np.median(shown[name])
        axes.plot([middle, middle], [row, row - 0.85], color=INK, lw=1)
    axes.set_yticks(np.arange(len(shown)) - 0.4, [f"{name}\n{np.median(values):.3g}" for name, values in shown.items()])
    _plain(axes.get_yticklabels())
    axes.set_ylim(len(shown) - 0.8, -1.1)
    _log_axis(axes.xaxis, axes.set_xlim, low)
    style_axes(axes, "rotation error [deg]", "")
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")


def _bins(x: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Split pairs by a number of each into bins of about equally many; equal numbers stay together."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, np.clip(len(x) // FEWEST, 1, BINS) + 1)))
    member = np.searchsorted(edges[1:-1], x, side="right")
    return [np.flatnonzero(member == i) for i in np.unique(member)]


def _uses_network(name: str, errors: Errors) -> bool:
    return name.startswith(errors.network)


def _line(name: str, errors: Errors) -> dict[str, Any]:
    return {"lw": 2.2, "zorder": 3} if _uses_network(name, errors) else {"lw": 1.3}


def _lowest(values: Iterable[NDArray[np.float64]]) -> float:
    """Return the power of ten below the smallest 1 % quantile of `values`: a single small error should not stretch the axis."""
    return float(10 ** np.floor(np.log10(min(np.quantile(v, 0.01) for v in values))))


def _log_axis(axis: Any, set_limits: Any, low: float) -> None:
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    set_limits(low, CEILING)
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(lambda *_: "")


def _plain(texts: Iterable[Text]) -> None:
    """Keep a name as it is: a dollar sign would start a formula."""
    for text in texts:
        text.set_parse_math(False)
