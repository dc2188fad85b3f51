"""How a text file of points is laid out: delimiter, header row, count line and columns are found out."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass

COMMENTS = ("#", "//", "%", "!")
MISSING = ("", "nan", "-nan", "null", "none", "na", "n/a")


@dataclass(frozen=True)
class Layout:
    """The layout of a text file.

    Attributes:
        delimiter: between columns; None for any white space.
        header: names of the columns; empty without a header row.
        count: number of points that a line before them says, or None.
        first: position of the first line of data.
        xyz: positions of the columns of coordinates.
        decimal_comma: whether numbers are written as 1,5.
        width: number of columns in the first line of data.
    """

    delimiter: str | None
    header: tuple[str, ...]
    count: int | None
    first: int
    xyz: tuple[int, int, int]
    decimal_comma: bool
    width: int

    def cells(self, line: str) -> list[str]:
        """Split a line into its columns."""
        return split(line, self.delimiter)

    def number(self, cell: str) -> float:
        """Read a number; an empty cell is NaN.

        Raises:
            ValueError: another word.
        """
        return _number(cell, self.decimal_comma)


def find_layout(lines: list[str]) -> Layout:
    """Find out the layout.

    Raises:
        ValueError: no line of three numbers, or fewer than three columns.
    """
    count, names = None, ()
    for first, line in enumerate(lines):
        remark = line.strip().startswith(COMMENTS)
        text = line.strip().lstrip("#/%! ") if remark else line.strip()
        if not text:
            continue
        delimiter = _delimiter(line.strip("\r\n") if not remark else text)
        cells = split(text, delimiter) if remark else split(line, delimiter)
        comma = delimiter in (";", "\t") and any(re.fullmatch(r"[+-]?\d+,\d+", cell.strip()) for cell in cells)
        if not remark and count is None and len(cells) == 1 and cells[0].strip().isdecimal():
            count = int(cells[0])
        elif not remark and _is_data(cells, names, comma):
            return Layout(delimiter, names, count, first, _positions(names) or (0, 1, 2), comma, len(cells))
        elif not remark and (names and _positions(names)):
            raise ValueError(f"line {first + 1} is {line.strip()[:60]!r}; expected numbers in the columns x, y and z")
        elif _positions(named := tuple(_plain(cell) for cell in cells)) or (not remark and not names):
            names = named
        elif not remark:
            raise ValueError(f"line {first + 1} is {line.strip()[:60]!r}; expected numbers in the first three columns")
    raise ValueError("no points; expected lines of three numbers or more, or with a header that names x, y and z")


def split(line: str, delimiter: str | None) -> list[str]:
    """Split a line at a delimiter; quotes may enclose it."""
    if delimiter is None:
        return line.split()
    return next(csv.reader([line.strip("\r\n")], delimiter=delimiter)) if '"' in line else line.strip("\r\n").split(delimiter)


def _delimiter(line: str) -> str | None:
    """Return the first of `;`, tab and comma that divides a line in three columns or more; None is white space."""
    return next((delimiter for delimiter in (";", "\t", ",") if line.count(delimiter) > 1), None)


def _is_data(cells: list[str], names: tuple[str, ...], comma: bool) -> bool:
    """Say whether the columns of coordinates hold numbers; without a header those are the first three."""
    positions = _positions(names) or (0, 1, 2)
    if len(cells) < 3:
        if cells and _is_number(cells[0], comma):
            raise ValueError(f"a line of {len(cells)} column(s), {' '.join(cells)[:60]!r}; expected at least x, y and z")
        return False
    return max(positions) < len(cells) and all(_is_number(cells[i], comma) for i in positions) and any(cells[i].strip() for i in positions)


def _is_number(cell: str, comma: bool) -> bool:
    try:
        _number(cell, comma)
    except ValueError:
        return False
    return True


def _number(cell: str, decimal_comma: bool) -> float:
    word = cell.strip().strip('"').strip()
    if word.lower() in MISSING:
        return float("nan")
    return float(word.replace(",", ".") if decimal_comma else word)


def _plain(name: str) -> str:
    """Return the name of a column without quotes and units: `"X (m)"` is x, ParaView's `Points:0` too."""
    plain = re.sub(r"\s*[\[(].*?[\])]\s*$", "", name.strip().strip('"').strip()).lower()
    point = re.fullmatch(r"points[:_]([012])", plain)
    return "xyz"[int(point[1])] if point else plain


def _positions(names: tuple[str, ...]) -> tuple[int, int, int] | None:
    if {"x", "y", "z"} <= set(names):
        return names.index("x"), names.index("y"), names.index("z")
    return None
