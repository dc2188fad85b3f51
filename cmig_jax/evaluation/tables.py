"""The results as a table: for the terminal, for Markdown, for LaTeX, for a page (the columns of Tables 1 to 4 and ours)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, Literal, NamedTuple

from cmig_jax.evaluation.engine import METADATA
from cmig_jax.evaluation.metrics import WIDER_RECALLS

Rows = Sequence[Sequence[str]]


class Column(NamedTuple):
    """How a metric is shown: its key in the results, heading, unit, factor from the key's unit, digits, and which value is the best."""

    key: str
    heading: str
    unit: str
    digits: int
    factor: float = 1.0
    best: Literal["low", "high", "none"] = "low"


COLUMNS = (
    Column("rmse_r_deg", "RMSE(R)", "deg", 2),
    Column("mae_r_deg", "MAE(R)", "deg", 2),
    Column("rmse_t", "RMSE(t)", "units", 4),
    Column("mae_t", "MAE(t)", "units", 4),
    Column("iso_r_deg_median", "median angle", "deg", 2),
    Column("iso_t_median", "median shift", "units", 4),
    Column("recall", "recall", "%", 1, 100.0, "high"),
    Column("closest_point", "closest point", "units", 4),
    Column("recall_closest_point", "recall (closest)", "%", 1, 100.0, "high"),
    Column("chamfer", "Chamfer", "squared units", 5),
    Column("seconds_per_pair", "time", "ms/pair", 1, 1000.0, "none"),
)
"""Lengths are in units of the normalised object."""
WIDER = tuple(
    Column(f"recall_{angle}_deg", f"within {angle} deg, {distance:g}", "%", 1, 100.0, "high") for angle, distance in WIDER_RECALLS.items()
)
"""For experiments that ask for starts of a refinement."""
BY_KEY = {column.key: column for column in (*COLUMNS, *WIDER)}


def text_table(results: Mapping[str, Any]) -> str:
    """Return the table for a terminal, headings and units on two lines.

    Args:
        results: what `evaluate` returned, or a part of it. A column that no method has is left out; a value that one lacks is a dash.

    Returns:
        The table, ending in a newline.

    Raises:
        ValueError: there is no method in the results.
    """
    columns, names, cells = _cells(results)
    head = [["method", *(c.heading for c in columns)], ["", *(f"[{c.unit}]" for c in columns)]]
    return text_rows(head, [[name, *(text for text, _ in row)] for name, row in zip(names, cells, strict=True)])


def markdown_table(results: Mapping[str, Any]) -> str:
    """Return the table in Markdown, the best value of a column in bold. Arguments and errors are those of `text_table`."""
    columns, names, cells = _cells(results)
    head = ["method", *(f"{c.heading} [{c.unit}]" for c in columns)]
    rows = [[name, *(f"**{text}**" if best else text for text, best in row)] for name, row in zip(names, cells, strict=True)]
    return markdown_rows([head], rows)


def latex_table(results: Mapping[str, Any]) -> str:
    """Return the table as a LaTeX tabular (package booktabs), the best value of a column in bold. As `text_table` otherwise."""
    columns, names, cells = _cells(results)
    head = [["method", *(latex_text(c.heading) for c in columns)], ["", *(f"[{latex_text(c.unit)}]" for c in columns)]]
    rows = [
        [latex_text(name), *(rf"\textbf{{{text}}}" if best else latex_text(text) for text, best in row)]
        for name, row in zip(names, cells, strict=True)
    ]
    return latex_rows(head, rows)


def html_table(results: Mapping[str, Any]) -> str:
    """Return the table in HTML, the best value of a column in bold. As `text_table` otherwise."""
    columns, names, cells = _cells(results)
    head = "".join(f'<th scope="col">{escape(c.heading)} <small>{escape(c.unit)}</small></th>' for c in columns)
    rows = [
        f'<tr><th scope="row">{escape(name)}</th>'
        + "".join(f"<td><strong>{escape(text)}</strong></td>" if best else f"<td>{escape(text)}</td>" for text, best in row)
        + "</tr>"
        for name, row in zip(names, cells, strict=True)
    ]
    lines = [f'<thead><tr><th scope="col">method</th>{head}</tr></thead>', "<tbody>", *rows, "</tbody>"]
    return "\n".join(["<table>", *lines, "</table>"]) + "\n"


def _cells(results: Mapping[str, Any]) -> tuple[list[Column], list[str], list[list[tuple[str, bool]]]]:
    """Choose the columns that have a value; return them, the methods, and rows of (text, best of its column)."""
    methods = {name: row for name, row in results.items() if name not in METADATA}
    if not methods:
        raise ValueError(f"results with the keys {sorted(results)}: expected at least one method")
    columns = [column for column in COLUMNS if any(column.key in row for row in methods.values())]
    best = {column.key: _best(column, methods) for column in columns}
    rows = []
    for row in methods.values():
        texts = {c.key: f"{row[c.key] * c.factor:.{c.digits}f}" if c.key in row else "–" for c in columns}
        rows.append([(texts[c.key], texts[c.key] == best[c.key]) for c in columns])
    return columns, list(methods), rows


def _best(column: Column, methods: Mapping[str, Mapping[str, float]]) -> str | None:
    """Return the best value as it is printed, so that equal prints are bold together; None where a comparison says nothing."""
    values = [row[column.key] for row in methods.values() if column.key in row]
    if column.best == "none" or len(values) < 2:
        return None
    return f"{(min if column.best == 'low' else max)(values) * column.factor:.{column.digits}f}"


def text_rows(head: Rows, rows: Rows) -> str:
    """Return rows of cells for a terminal, below one or more rows of headings."""
    lines = _aligned([*head, *rows], "  ")
    return "\n".join([*lines[: len(head)], "-" * len(lines[0]), *lines[len(head) :]]) + "\n"


def markdown_rows(head: Rows, rows: Rows) -> str:
    """Return rows of cells in Markdown, below one row of headings."""
    cells = [[cell.replace("|", r"\|") for cell in row] for row in [*head, *rows]]
    lines = _aligned(cells, " | ")
    first, *others = (max(len(row[i]) for row in cells) for i in range(len(cells[0])))
    rule = " | ".join(["-" * first, *("-" * (width - 1) + ":" for width in others)])
    return "".join(f"| {line} |\n" for line in [lines[0], rule, *lines[1:]])


def latex_rows(head: Rows, rows: Rows) -> str:
    """Return rows of cells (`latex_text`, or LaTeX) as a tabular (package booktabs), below one or more rows of headings."""
    lines = [rf"{line} \\" for line in _aligned([*head, *rows], " & ")]
    body = [r"\toprule", *lines[: len(head)], r"\midrule", *lines[len(head) :], r"\bottomrule"]
    return "\n".join([rf"\begin{{tabular}}{{l{'r' * (len(head[0]) - 1)}}}", *body, r"\end{tabular}"]) + "\n"


def _aligned(rows: Rows, separator: str) -> list[str]:
    """Return one line a row, the first column padded on the right and the others on the left."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        separator.join([row[0].ljust(widths[0]), *(text.rjust(w) for text, w in zip(row[1:], widths[1:], strict=True))]) for row in rows
    ]


def latex_text(text: str) -> str:
    """Escape what LaTeX reads as a command, and write a dash and a plus-minus sign as LaTeX does."""
    escaped = "".join(f"\\{letter}" if letter in "&%$#_{}" else letter for letter in text)
    return escaped.replace("–", "--").replace("±", r"$\pm$")
