"""PLY: ASCII and binary of both byte orders, any elements and attributes.

Own code, since the libraries read lists and text row by row, or keep neither attributes nor double precision.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from trimesh.geometry import triangulate_quads
from trimesh.util import triangle_strips_to_faces

from cmig_jax.data.formats.content import Parsed, axes, coordinate_type, moved_columns, normals_of, stacked
from cmig_jax.data.formats.ply_elements import Column, Element, Property, decode, encode

_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
_NAMES |= {"i8": "int64", "u8": "uint64"}  # not in the specification, but in use
_SIZED = {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_TYPES = {name: code for code, name in _NAMES.items()} | _SIZED
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
_FACES = ("vertex_indices", "vertex_index")


@dataclass(frozen=True)
class Ply:
    """A PLY file: the lines of comments and `obj_info`, and the elements with their columns."""

    remarks: tuple[str, ...]
    elements: tuple[tuple[Element, dict[str, Column]], ...]

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode in binary: vertices moved, normals of vertices and faces turned."""
        return _encode(self.remarks, [_moved(element, columns, target_from_source) for element, columns in self.elements])


def read_ply(content: bytes, suffix: str) -> Parsed:
    """Read a PLY file (`Format.read`)."""
    order, remarks, elements, start = _header(content)
    data, scale = memoryview(content), ""
    if order == "":
        data, start, order, scale = _doubles(content[start:]), 0, "=", "doubles"
    read = []
    for element in elements:
        columns, start = decode(data, start, element.as_doubles() if scale else element, order)
        read.append((element, _typed(element, columns) if scale else columns))
    rest = bytes(data[start:])
    if scale and rest:
        raise ValueError(f"{len(rest) // 8} numbers too many; expected as many as the elements of the header have")
    if rest.strip(b"\r\n \t\0"):
        raise ValueError(f"{len(rest)} bytes behind the last element; expected none")
    return _parsed(Ply(remarks, tuple(read)))


def encode_ply(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points, and faces if there are any (`Format.encode`)."""
    code = coordinate_type(points).str[1:]
    vertex = Element("vertex", len(points), tuple(Property(name, code) for name in "xyz"))
    elements: list[tuple[Element, dict[str, Column]]] = [(vertex, dict(zip("xyz", points.T, strict=True)))]
    if faces is not None:
        elements.append((Element("face", len(faces), (Property("vertex_indices", "i4", "u1"),)), {"vertex_indices": faces}))
    return _encode((), elements)


def _header(content: bytes) -> tuple[str, tuple[str, ...], list[Element], int]:
    """Return the byte order ("" for text), remarks, elements, and the position of the data."""
    begin = re.match(rb"(?:\xef\xbb\xbf)?\s*ply[ \t]*(\r\n|\r|\n)", content, re.IGNORECASE)
    if begin is None:
        raise ValueError("expected a first line `ply`")
    end = re.compile(rb"(?:\r|\n)[ \t]*end_header[ \t]*" + (rb"\r" if begin[1] == b"\r" else rb"\r?\n")).search(content, begin.end() - 1)
    if end is None:
        raise ValueError("no end_header line; expected one behind the elements")
    order, remarks, elements = None, [], []
    for line in content[begin.end() : end.start()].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = _ORDERS.get(words[1] if len(words) > 1 else "")
        elif words[:1] in (["comment"], ["obj_info"]):
            remarks.append(line.strip())
        elif words[:1] == ["element"]:
            elements.append(_element(words))
        elif words[:1] == ["property"] and elements:
            elements[-1] = replace(elements[-1], properties=(*elements[-1].properties, _property(words)))
        elif words:
            raise ValueError(f"header line {line!r}; expected format, comment, obj_info, element or property")
    if order is None:
        raise ValueError(f"no line `format` with one of {', '.join(_ORDERS)} in the header")
    return order, tuple(remarks), elements, end.end()


def _element(words: list[str]) -> Element:
    if len(words) != 3 or not words[2].isdecimal():
        raise ValueError(f"header line {' '.join(words)!r}; expected element NAME COUNT")
    return Element(words[1], int(words[2]), ())


def _property(words: list[str]) -> Property:
    types = [_TYPES.get(word.lower()) for word in words[1:-1]]
    if words[1:2] == ["list"] and len(words) == 5 and types[1] and types[2]:
        return Property(words[4], types[2], types[1])
    if len(words) == 3 and types[0]:
        return Property(words[2], types[0])
    raise ValueError(f"header line {' '.join(words)!r}; expected property TYPE NAME, or property list TYPE TYPE NAME")


def _doubles(text: bytes) -> memoryview:
    """Return the numbers of a text as bytes of doubles."""
    if not text.strip():
        return memoryview(b"")
    try:
        return memoryview(np.fromstring(text, sep=" ").view(np.uint8))  # pyright: ignore[reportArgumentType, reportCallIssue]
    except ValueError as error:
        raise ValueError("a word among the data; expected numbers alone") from error


def _typed(element: Element, columns: dict[str, Column]) -> dict[str, Column]:
    """Convert columns that were read as doubles to the types of the header."""
    typed: dict[str, Column] = {}
    with np.errstate(invalid="ignore", over="ignore"):
        for p in element.properties:
            column = columns[p.name]
            typed[p.name] = [row.astype(p.type) for row in column] if isinstance(column, list) else column.astype(p.type)
    return typed


def _parsed(content: Ply) -> Parsed:
    found = {element.name.lower(): columns for element, columns in reversed(content.elements)}
    vertex = {name: column for name, column in found.get("vertex", {}).items() if isinstance(column, np.ndarray) and column.ndim == 1}
    names = axes(list(vertex))
    if names is None:
        raise ValueError(f"elements {list(found)}, columns {list(vertex)} of vertices; expected an element vertex with x, y and z")
    faces = None
    for name in _FACES:
        polygons = found.get("face", {}).get(name, ())
        if len(polygons):
            polygons = polygons if isinstance(polygons, np.ndarray) else [row for row in polygons if len(row) > 2]
            faces = np.asarray(triangulate_quads(polygons), np.int64).reshape(-1, 3)
    strips = found.get("tristrips", {}).get(_FACES[0], ())
    if faces is None and len(strips):
        pieces = [np.split(strip, np.flatnonzero(strip < 0)) for strip in strips]  # -1 begins another strip
        faces = triangle_strips_to_faces([piece[piece >= 0] for strip in pieces for piece in strip if (piece >= 0).sum() > 2])
    return Parsed(stacked(vertex, names), faces, content, normals=partial(normals_of, vertex))


def _moved(element: Element, columns: dict[str, Column], matrix: np.ndarray) -> tuple[Element, dict[str, Column]]:
    numbers = {name: column for name, column in columns.items() if isinstance(column, np.ndarray) and column.ndim == 1}
    moved = moved_columns(numbers, matrix)
    changed = {name: column.dtype.str[1:] for name, column in moved.items() if column is not numbers[name]}
    properties = tuple(replace(p, type=changed.get(p.name, p.type)) for p in element.properties)
    return replace(element, properties=properties), {**columns, **moved}


def _encode(remarks: tuple[str, ...], elements: list[tuple[Element, dict[str, Column]]]) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *remarks]
    for element, _ in elements:
        lines.append(f"element {element.name} {element.count}")
        for p in element.properties:
            kind = f"list {_NAMES[p.length]} {_NAMES[p.type]}" if p.length else _NAMES[p.type]
            lines.append(f"property {kind} {p.name}")
    header = "\n".join([*lines, "end_header", ""]).encode("latin-1")
    return header + b"".join(encode(element, columns) for element, columns in elements)
