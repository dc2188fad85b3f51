"""An experiment's rows as a picture: the errors of every seed, and their mean."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from cmig_jax.evaluation.tables import BY_KEY
from cmig_jax.experiments.run import Results
from cmig_jax.experiments.schema import Experiment
from cmig_jax.experiments.table import spread
from cmig_jax.report.colours import INK, SOURCE, TARGET
from cmig_jax.report.plots import save, style_axes


def plot_rows(name: str, experiment: Experiment, results: Results, path: Path) -> None:
    """Draw the two metrics of `experiment.drawn` by row: a dot for each seed, a line at the mean.

    Args:
        name: of the experiment, for the title.
        experiment: says which metrics.
        results: at least one outcome has metrics.
        path: the picture.
    """
    labels = list(dict.fromkeys(outcome.job.row.label for outcome in results.outcomes if outcome.metrics))
    figure = Figure(figsize=(8.5, 1.1 + 0.34 * len(labels)), layout="constrained")
    for axes, key, colour in zip(figure.subplots(1, 2, sharey=True), experiment.drawn, (TARGET, SOURCE), strict=True):
        column = BY_KEY[key]
        for height, label in enumerate(labels):
            values = [o.metrics[key] * column.factor for o in results.outcomes if o.metrics and o.job.row.label == label]
            axes.plot(values, [height] * len(values), "o", color=colour, markersize=5, alpha=0.75, clip_on=False)
            axes.vlines(spread(values)[0], height - 0.28, height + 0.28, color=INK, linewidth=1.5)
        axes.set_xlim(left=0)
        axes.set_ylim(len(labels) - 0.5, -0.5)
        axes.set_yticks(range(len(labels)), labels)
        style_axes(axes, f"{column.heading}, {column.unit}", "")
        axes.grid(visible=False, axis="y")
    figure.suptitle(name, color=INK, fontsize=11)
    save(figure, path)
