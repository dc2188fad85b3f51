"""The data of a PLY file: elements whose rows hold numbers and lists of numbers."""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace

import numpy as np

Column = np.ndarray | list[np.ndarray]
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q", "f4": "f", "f8": "d"}


@dataclass(frozen=True)
class Property:
    """A column of an element: its type such as "f4", and for a list the type of the list's length."""

    name: str
    type: str
    length: str | None = None


@dataclass(frozen=True)
class Element:
    """An element of the header.

    Attributes:
        name: for example "vertex".
        count: number of rows.
        properties: in the order of the file.
    """

    name: str
    count: int
    properties: tuple[Property, ...]

    def least_size(self) -> int:
        """Return the fewest bytes that the rows take: all lists empty."""
        return self.count * sum(int((p.length or p.type)[1]) for p in self.properties)

    def as_doubles(self) -> Element:
        """Return the element as it lies in memory when its text was read as doubles."""
        return replace(self, properties=tuple(Property(p.name, "f8", p.length and "f8") for p in self.properties))


def decode(data: memoryview, start: int, element: Element, order: str) -> tuple[dict[str, Column], int]:
    """Read the rows of an element.

    Args:
        data: bytes of the file.
        start: position of the first row.
        element: what the header says.
        order: "<" or ">".

    Returns:
        A column `[count]` for each number; for a list `[count, L]` if all have the length L, else an array for each row; and the
        position behind the rows.

    Raises:
        ValueError: the file is too short.
    """
    if element.least_size() > len(data) - start:
        raise ValueError(_short(element, element.least_size(), len(data) - start))
    kind = _row_type(data, start, element, order)
    if kind is not None and kind.itemsize * element.count <= len(data) - start:
        rows = np.frombuffer(data, kind, element.count, start)
        lists = [p for p in element.properties if p.length]
        if all((rows[f"{p.name} length"] == kind[p.name].shape[0]).all() for p in lists):
            return {p.name: rows[p.name] for p in element.properties}, start + kind.itemsize * element.count
    elif kind is not None and not any(p.length for p in element.properties):
        raise ValueError(_short(element, kind.itemsize * element.count, len(data) - start))
    return _decode_lists(data, start, element, order)


def encode(element: Element, columns: dict[str, Column]) -> bytes:
    """Encode rows in little-endian order."""
    fields, ragged = [], False
    for p in element.properties:
        column = columns[p.name]
        ragged = ragged or isinstance(column, list)
        if p.length:
            fields.append((f"{p.name} length", "<" + p.length))
        fields.append((p.name, "<" + p.type, np.shape(column)[1:]) if not isinstance(column, list) else (p.name, "<" + p.type))
    if ragged:
        return _encode_lists(element, columns)
    rows = np.zeros(element.count, fields)
    for p in element.properties:
        rows[p.name] = columns[p.name]
        if p.length:
            rows[f"{p.name} length"] = np.shape(columns[p.name])[1]
    return rows.tobytes()


def _row_type(data: memoryview, start: int, element: Element, order: str) -> np.dtype | None:
    """Return the type of a row if all have lists as long as the first row's; None if not even the first row is there."""
    fields, position = [], start
    for p in element.properties:
        shape = ()
        if p.length:
            if element.count == 0:
                length = 0
            elif position + int(p.length[1]) > len(data):
                return None
            else:
                length = int(np.frombuffer(data, order + p.length, 1, position)[0])
            if length < 0 or length > len(data):
                return None
            fields.append((f"{p.name} length", order + p.length))
            shape, position = (length,), position + int(p.length[1])
        fields.append((p.name, order + p.type, shape))
        position += int(p.type[1]) * int(np.prod(shape))
    return np.dtype(fields)


def _decode_lists(data: memoryview, start: int, element: Element, order: str) -> tuple[dict[str, Column], int]:
    columns: dict[str, list] = {p.name: [] for p in element.properties}
    readers = [
        (columns[p.name], struct.Struct(order + _CODES[p.length or p.type]), np.dtype(order + p.type) if p.length else None)
        for p in element.properties
    ]
    for row in range(element.count):
        for column, number, items in readers:
            try:
                (value,) = number.unpack_from(data, start)
                start += number.size
                if items is not None:
                    if not 0 <= value <= len(data):
                        raise ValueError(f"a list of {value} numbers")
                    value = np.frombuffer(data, items, int(value), start) if value else np.zeros(0, items)
                    start += value.nbytes
            except (struct.error, ValueError) as error:
                raise ValueError(f"{element.name} {row} of {element.count} cannot be read ({error}); is the file cut short?") from error
            column.append(value)
    return {p.name: columns[p.name] if p.length else np.array(columns[p.name], p.type) for p in element.properties}, start


def _encode_lists(element: Element, columns: dict[str, Column]) -> bytes:
    parts = []
    for row in range(element.count):
        for p in element.properties:
            value = np.asarray(columns[p.name][row], "<" + p.type)
            if p.length:
                parts.append(np.array(len(value), "<" + p.length).tobytes())
            parts.append(value.tobytes())
    return b"".join(parts)


def _short(element: Element, expected: int, found: int) -> str:
    rows = max(0, found) * element.count // expected
    return f"data for {rows} rows of the element {element.name!r}; expected {element.count} rows"
