"""Pictures and the page of an evaluation, in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cmig_jax.data.pairs import Pair
from cmig_jax.evaluation.errors import Errors
from cmig_jax.evaluation.evaluate import Evaluation
from cmig_jax.evaluation.matches import Matches, matches
from cmig_jax.report.curve import plot_curve
from cmig_jax.report.figures import write_figures
from cmig_jax.report.gallery import Example, choose
from cmig_jax.report.page import Report, view_titles, write_page
from cmig_jax.report.plots import plot_pairs, plot_views

PAGE = "report.html"
PICTURED = 4  # pairs


def draw(evaluation: Evaluation, log: Path | None = None) -> None:
    """Draw some pairs before and after, the views of one, and the training curve.

    Args:
        evaluation: whose pairs; the pictures go into its folder.
        log: `log.jsonl` of the training, if there is one.
    """
    network, pairs, folder = evaluation.network, evaluation.pairs, evaluation.folder
    positions = [int(i) for i in np.unique(np.linspace(0, len(pairs) - 1, PICTURED).astype(int))]
    chosen = [pairs[i] for i in positions]
    matched = matches(network, chosen)
    plot_pairs([_picture(p, m, evaluation.errors, i) for p, m, i in zip(chosen, matched, positions, strict=True)], folder / "pairs.png")
    if "views" in chosen[0]:
        plot_views(chosen[0]["views"][0], folder / "views.png", title=view_titles(network.config.views)[0])
    if log is not None and log.exists():
        try:
            plot_curve(log, folder / "curve.png")
        except ValueError as error:
            print(f"no training curve: {error}")


def write_report(evaluation: Evaluation, name: str, count: int) -> Path:
    """Write `report.html` and its figures into the folder of an evaluation; return the page.

    Args:
        evaluation: what it shows.
        name: of the run or the weights, for the heading.
        count: pairs to show: the worst, and some down to the best.

    Raises:
        ValueError: `count` below 1.
    """
    network, pairs, errors = evaluation.network, evaluation.pairs, evaluation.errors
    chosen = choose(errors.methods[errors.network].rotation_deg, count)
    drawn = [pairs[position] for position, _ in chosen]
    matched = matches(network, drawn, progress=True)
    names = pairs.names
    examples = [Example(i, rank, pair, m, names[i]) for (i, rank), pair, m in zip(chosen, drawn, matched, strict=True)]
    figures = write_figures(evaluation.folder, errors)
    page = evaluation.folder / PAGE
    write_page(page, Report(name, evaluation.checkpoint, network.config, evaluation.results, errors, examples, figures))
    return page


def _picture(pair: Pair, matched: Matches | None, errors: Errors, position: int) -> dict[str, Any]:
    """Describe a pair for `plot_pairs`: the network's pose, and the correspondences that the pose uses."""
    poses = errors.methods[errors.network]
    described = {**pair, "R": poses.R[position], "t": poses.t[position], "title": errors.category[position]}
    if matched is not None:
        source, target = matched.source[matched.used], matched.target[matched.chosen[matched.used]]
        described |= {"source_keypoints": source, "target_keypoints": target, "correct": matched.right[matched.used]}
    return described
