"""Points as text: XYZ, TXT, CSV, ASC and PTS, a point a line."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from cmig_jax.data.formats.content import Parsed, are_normals, moved_points, normal_axes, turned, written, written_coordinates
from cmig_jax.data.formats.text_layout import COMMENTS, Layout, find_layout

_HEAD = 1_000_000  # characters in which the header must end


@dataclass(frozen=True)
class Text:
    """A text file: its lines, and what is known of them.

    Attributes:
        text: all of it, with `\\n` at the end of lines.
        layout: where the points are in it.
        points: `[P, 3]` of its lines.
        suffix: of the file.
        encoding: of its characters.
        line_end: as in the file.
    """

    text: str
    layout: Layout
    points: np.ndarray
    suffix: str
    encoding: str
    line_end: str

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode with new numbers in the columns of coordinates and normals; all other columns and lines stay.

        For another suffix the delimiter, header and count line are those that are usual for it.
        """
        points = moved_points(self.points, target_from_source)
        numbers = written_coordinates(points)
        columns = list(self.layout.xyz)
        normals = self._normals()
        if normals:
            vectors = turned(_numbers(self.text, self.layout, normals), target_from_source)
            numbers = [[*point, *normal] for point, normal in zip(numbers, written(vectors), strict=True)]
            columns += normals
        if self.layout.decimal_comma:
            numbers = [[number.replace(".", ",") for number in row] for row in numbers]
        lines = self._lines(numbers, columns, suffix)
        return (self.line_end.join(lines) + self.line_end).encode(self.encoding)

    def normals(self) -> np.ndarray | None:
        """Return the normals of the points `[P, 3]`, or None."""
        columns = self._normals()
        return None if columns is None else _numbers(self.text, self.layout, columns)

    def _normals(self) -> tuple[int, int, int] | None:
        """Return the columns of normals: by name, or without a header those behind x y z if all have the length 1."""
        layout = self.layout
        named = normal_axes(list(layout.header))
        if named:
            a, b, c = (layout.header.index(name) for name in named)
            return a, b, c
        if layout.header or layout.width < 6:
            return None
        try:
            return (3, 4, 5) if are_normals(_numbers(self.text, layout, (3, 4, 5))) else None
        except ValueError:
            return None

    def _lines(self, numbers: list[list[str]], columns: list[int], suffix: str) -> list[str]:
        layout, same, row = self.layout, suffix == self.suffix, 0
        separator = layout.delimiter or " " if same else "," if suffix == ".csv" else " "
        lines = self.text.split("\n")
        result = lines[: layout.first] if same else _head(suffix, layout.header, len(numbers))
        for line in lines[layout.first :]:
            if not line.strip() or line.strip().startswith(COMMENTS):
                result += [line] if same and line.strip() else []
                continue
            cells = layout.cells(line)
            for column, number in zip(columns, numbers[row], strict=True):
                cells[column] = number
            result.append(separator.join(cells))
            row += 1
        return result


def read_text(content: bytes, suffix: str) -> Parsed:
    """Read a text file of points (`Format.read`)."""
    text, encoding = _decoded(content)
    line_end = "\r\n" if "\r\n" in text else "\n"
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    layout = find_layout(text[:_HEAD].split("\n"))
    points = _numbers(text, layout, layout.xyz)
    if layout.count is not None and len(points) < layout.count:
        raise ValueError(f"{len(points)} lines of points; expected {layout.count}, as a line before them says")
    parsed = Text(text, layout, points, suffix, encoding, line_end)
    return Parsed(points, None, parsed, normals=parsed.normals)


def encode_text(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points (`Format.encode`)."""
    separator = "," if suffix == ".csv" else " "
    rows = written_coordinates(points)
    lines = _head(suffix, ("x", "y", "z"), len(rows)) + [separator.join(row) for row in rows]
    return ("\n".join(lines) + "\n").encode()


def _head(suffix: str, header: tuple[str, ...], count: int) -> list[str]:
    """Return the lines before the points that are usual for a suffix."""
    if suffix == ".pts":
        return [str(count)]
    return [",".join(header)] if suffix == ".csv" and header else []


def _decoded(content: bytes) -> tuple[str, str]:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16"), "utf-16"
    if b"\0" in content:
        raise ValueError("binary data; expected text, a point a line")
    try:
        return content.decode("utf-8-sig"), "utf-8"
    except UnicodeDecodeError:
        return content.decode("latin-1"), "latin-1"


def _numbers(text: str, layout: Layout, columns: tuple[int, int, int]) -> np.ndarray:
    """Return three columns `[P, 3]` float64."""
    if not layout.decimal_comma:
        try:
            return np.loadtxt(io.StringIO(text), delimiter=layout.delimiter, skiprows=layout.first, usecols=columns, ndmin=2, quotechar='"')
        except ValueError:
            pass  # an empty cell, another remark, or damage: line by line
    rows = []
    for number, line in enumerate(text.split("\n"), 1):
        if number <= layout.first or not line.strip() or line.strip().startswith(COMMENTS):
            continue
        try:
            cells = layout.cells(line)
            rows.append([layout.number(cells[i]) for i in columns])
        except (ValueError, IndexError) as error:
            places = "x, y and z" if layout.header else "the first three columns" if columns == (0, 1, 2) else "its columns"
            raise ValueError(f"line {number} is {line.strip()[:60]!r}; expected numbers in {places}") from error
    return np.array(rows, np.float64).reshape(-1, 3)
