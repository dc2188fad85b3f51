"""The curve of a training: losses and validation errors over the steps."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from cmig_jax.report.colours import CORRECT, INK, SOURCE, TARGET
from cmig_jax.report.plots import save, style_axes

TERMS = ("#7b6ba8", "#b5843c", "#5b8c85", "#2c5f8d", "#b0566b", "#6f6f6f", "#8a9a3b", "#c06f3a")
"""Colours of the terms of the loss, in the order of the log."""
NOT_TERMS = {"step", "loss", "gradient_norm", "epoch", "learning_rate", "pairs_per_second"}
ERRORS = {"val_rmse_r_deg": ("RMSE(R)", TARGET), "val_mae_r_deg": ("MAE(R)", SOURCE), "val_iso_r_deg_median": ("median angle", CORRECT)}
WINDOWS = 200


def plot_curve(log_path: Path, path: Path) -> None:
    """Draw the losses and, where the log has them, the validation errors over the steps.

    Args:
        log_path: JSON lines. A training line has `step`, `loss` and the terms of the losses, whose iterations are added up; a
            validation line has `step` and `val_rmse_r_deg` (also drawn: `val_mae_r_deg`, `val_iso_r_deg_median`). A last line that an
            interruption cut short is left out.
        path: the picture.

    Raises:
        ValueError: a line that is not a JSON object with a step, or no line with a loss; the message names the file.
    """
    lines = _read_log(log_path)
    training = [line for line in lines if "loss" in line]
    validation = [line for line in lines if any(key in line for key in ERRORS)]
    if not training:
        raise ValueError(f"{log_path}: expected at least one line with a loss")
    figure = Figure(figsize=(10.0 if validation else 5.6, 3.8), layout="constrained")
    panels = figure.subplots(1, 2 if validation else 1, squeeze=False)[0]
    _draw_losses(panels[0], training)
    if validation:
        _draw_errors(panels[1], validation)
    save(figure, path)


def _read_log(log_path: Path) -> list[dict[str, Any]]:
    texts = log_path.read_text(errors="replace").splitlines()
    lines = []
    for i, text in enumerate(texts):
        try:
            line = json.loads(text)
            line["step"] = float(line["step"])
        except (ValueError, TypeError, KeyError) as error:
            if i == len(texts) - 1 and isinstance(error, json.JSONDecodeError):
                break
            raise ValueError(f"{log_path}, line {i + 1}: expected a JSON object with a step, not {text[:80]!r}") from error
        lines.append(line)
    return lines


def _draw_losses(axes: Axes, lines: Sequence[Mapping[str, Any]]) -> None:
    steps = np.array([line["step"] for line in lines])
    terms: dict[str, NDArray[Any]] = {}
    for key in dict.fromkeys(key for line in lines for key in line):
        name = re.sub(r"_\d+$", "", key)
        if key not in NOT_TERMS:
            terms[name] = terms.get(name, 0.0) + np.array([line.get(key, np.nan) for line in lines], float)
    total = np.array([line["loss"] for line in lines], float)
    windows = [window for window in np.array_split(np.arange(len(steps)), min(len(steps), WINDOWS)) if len(window)]
    middle = [steps[window].mean() for window in windows]
    low, high = np.array([np.quantile(total[window], [0.1, 0.9]) for window in windows]).T
    axes.fill_between(middle, low, high, color=INK, alpha=0.12, linewidth=0)
    axes.plot(middle, [total[window].mean() for window in windows], color=INK, lw=1.8, label="total")
    for name, colour in zip(terms, itertools.cycle(TERMS), strict=False):
        axes.plot(middle, [terms[name][window].mean() for window in windows], color=colour, lw=1.1, label=name.replace("_", " "))
    drawn = np.concatenate([total, *terms.values()])
    if np.nanmin(drawn) > 0:
        axes.set_yscale("log")
    _finish_panel(axes, "loss")


def _draw_errors(axes: Axes, lines: Sequence[Mapping[str, Any]]) -> None:
    for key, (label, colour) in ERRORS.items():
        found = [(line["step"], line[key]) for line in lines if key in line]
        if found:
            steps, values = np.array(found).T
            axes.plot(steps, values, color=colour, lw=1.6, marker="o", ms=3, label=label)
            if key == "val_rmse_r_deg" and np.isfinite(values).any():
                lowest = int(np.nanargmin(values))
                axes.axhline(values[lowest], color=colour, lw=0.8, ls=":")
                style: dict[str, Any] = {"textcoords": "offset points", "ha": "left", "va": "top", "color": colour, "fontsize": 8}
                axes.annotate(f"lowest {values[lowest]:.2f}", (0, values[lowest]), (4, -2), xycoords=("axes fraction", "data"), **style)
    axes.set_ylim(bottom=0)
    _finish_panel(axes, "validation error [deg]")


def _finish_panel(axes: Axes, ylabel: str) -> None:
    style_axes(axes, "step", ylabel)
    axes.grid(visible=False, axis="x")
    axes.legend(frameon=False, fontsize=8, labelcolor=INK)
