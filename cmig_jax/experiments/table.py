"""The results of an experiment as a table: mean and spread over seeds, the paper's figures beside them, the command of every row."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from cmig_jax.evaluation.tables import BY_KEY, COLUMNS, Column, latex_rows, latex_text, markdown_rows, text_rows
from cmig_jax.experiments.run import Outcome, Results
from cmig_jax.experiments.schema import Experiment, Row

QUOTED = tuple(column for column in COLUMNS if column.key in ("rmse_r_deg", "mae_r_deg", "rmse_t", "mae_t"))
EMPTY = "–"


def table(experiment: Experiment, results: Results, style: str = "text") -> str:
    """Return the table; a row that was not run, or failed, is empty.

    Args:
        experiment: the table or figure.
        results: of its jobs.
        style: `text` for a terminal, `markdown`, or `latex` (package booktabs).
    """
    shown = [BY_KEY[key] for key in experiment.columns]
    rows = [[name, "", *(_cell(column, [metrics]) for column in shown)] for name, metrics in results.baselines.items()]
    rows += [_row(row, [o for o in results.outcomes if o.job.row is row], shown) for row in experiment.rows]
    quoted = any(row.quoted for row in experiment.rows)
    if quoted:
        empty = [EMPTY] * len(QUOTED)
        figures = [empty] * len(results.baselines) + [_quoted(row) for row in experiment.rows]
        rows = [[*row, *cells] for row, cells in zip(rows, figures, strict=True)]
    headings = ["", "seeds", *(f"{c.heading} [{c.unit}]" for c in shown), *(f"quoted {c.heading}" for c in QUOTED if quoted)]
    if style == "latex":
        headings, *rows = [[latex_text(cell) for cell in row] for row in [headings, *rows]]
    return {"text": text_rows, "markdown": markdown_rows, "latex": latex_rows}[style]([headings], rows)


def notes(experiment: Experiment, results: Results) -> list[str]:
    """Say of every row and job that has no result why, a line each."""
    absent = [f"{row.label}: {row.absent}" for row in experiment.rows if row.absent]
    return absent + [f"{o.job.row.label}, seed {o.job.seed}: {o.problem}" for o in results.outcomes if o.problem]


def as_json(name: str, experiment: Experiment, results: Results) -> dict[str, Any]:
    """Return everything that the table shows, and the commands."""
    rows = []
    for row in experiment.rows:
        outcomes = [o for o in results.outcomes if o.job.row is row]
        rows.append(
            {
                "label": row.label,
                "preset": row.preset,
                "absent": row.absent,
                "flags": dict(experiment.protocol) | dict(row.flags),
                "test_flags": dict(row.test),
                "then": row.then,
                "quoted_from_the_paper": asdict(row.quoted) if row.quoted else None,
                "runs": [
                    {"seed": o.job.seed, "commands": o.job.commands(), "metrics": o.metrics and dict(o.metrics), "problem": o.problem}
                    for o in outcomes
                ],
            }
        )
    return {"experiment": name, "about": experiment.about, "rows": rows, "baselines": {k: dict(v) for k, v in results.baselines.items()}}


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Return mean and standard deviation (of a sample; 0 for a single value)."""
    return statistics.fmean(values), statistics.stdev(values) if len(values) > 1 else 0.0


def _row(row: Row, outcomes: Sequence[Outcome], shown: Sequence[Column]) -> list[str]:
    found = [o.metrics for o in outcomes if o.metrics is not None]
    failed = sum(o.problem.startswith("failed") for o in outcomes)
    seeds = f"{len(found)}" + (f", {failed} failed" if failed else "")
    return [row.label, seeds if outcomes else EMPTY, *(_cell(column, found) for column in shown)]


def _cell(column: Column, found: Sequence[Mapping[str, float]]) -> str:
    values = [metrics[column.key] * column.factor for metrics in found if column.key in metrics]
    if not values:
        return EMPTY
    mean, deviation = spread(values)
    text = f"{mean:.{column.digits}f}"
    return f"{text} ± {deviation:.{column.digits}f}" if len(values) > 1 and column.best != "none" else text


def _quoted(row: Row) -> list[str]:
    if row.quoted is None:
        return [EMPTY] * len(QUOTED)
    values = asdict(row.quoted)
    return [f"{values[column.key]:.{max(column.digits, 3)}f}" for column in QUOTED]
