"""PCD (Point Cloud Library): ascii, binary and binary_compressed.

`pypcd4` reads these too, but brings pydantic and trusts the sizes of the header; the LZF compression is that library's `python-neo-lzf`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import partial

import numpy as np

from cmig_jax.data.formats.content import Parsed, axes, coordinate_type, moved_columns, normals_of, stacked

_KINDS = {"F": "f", "U": "u", "I": "i"}
_LETTERS = {kind: letter for letter, kind in _KINDS.items()}
_LARGEST_RATIO = 100  # LZF: three bytes stand for 264 at most


@dataclass(frozen=True)
class Header:
    """The header: names and types of the fields, sizes of the grid, and the sensor's pose.

    Attributes:
        names: as in the file, so that several may be `_` (padding).
        kind: type of a row; its fields are `names` made unique.
        width: columns of the grid, or number of points.
        height: rows of the grid, or 1.
        viewpoint: seven numbers as they stand in the file.
        encoding: "ascii", "binary" or "binary_compressed".
    """

    names: tuple[str, ...]
    kind: np.dtype
    width: int
    height: int
    viewpoint: str
    encoding: str


@dataclass(frozen=True)
class Pcd:
    """A PCD file: header and columns by unique name, `[P]` or `[P, count]`."""

    header: Header
    columns: dict[str, np.ndarray]

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode as binary: points moved, normals turned; the viewpoint, by which viewers place a cloud, stays."""
        return _encode(self.header, moved_columns(self.columns, target_from_source))


def read_pcd(content: bytes, suffix: str) -> Parsed:
    """Read a PCD file (`Format.read`)."""
    header, start = _header(content)
    data, count = memoryview(content)[start:], header.width * header.height
    if header.encoding == "ascii":
        columns = _ascii(bytes(data), header.kind, count)
    elif header.encoding == "binary":
        if len(data) < count * header.kind.itemsize:
            raise ValueError(f"{len(data)} bytes of data; expected {count * header.kind.itemsize} for {count} points")
        rows = np.frombuffer(data, header.kind, count)
        columns = {name: rows[name] for name in header.kind.names or ()}
    else:
        columns = _compressed(data, header.kind, count)
    names = axes([name for name, column in columns.items() if column.ndim == 1])
    if names is None:
        raise ValueError(f"fields {' '.join(header.names)}; expected x y z among them")
    return Parsed(stacked(columns, names), None, Pcd(header, columns), normals=partial(normals_of, columns))


def encode_pcd(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points (`Format.encode`)."""
    kind = coordinate_type(points)
    header = Header(("x", "y", "z"), np.dtype([(name, kind) for name in "xyz"]), len(points), 1, "0 0 0 1 0 0 0", "binary")
    return _encode(header, {name: points[:, i].astype(kind) for i, name in enumerate("xyz")})


def _header(content: bytes) -> tuple[Header, int]:
    lines, position = {}, 0
    while position < len(content) and "DATA" not in lines:
        end = content.find(b"\n", position)
        end = len(content) if end < 0 else end
        words = content[position:end].decode("latin-1").split()
        if words and not words[0].startswith("#"):
            lines[words[0].upper()] = words[1:]
        position = end + 1
        if len(lines) > 20:
            break
    missing = [name for name in ("FIELDS", "SIZE", "TYPE", "DATA") if not lines.get(name)]
    if missing:
        raise ValueError(f"no line {' or '.join(missing)} in the header; expected a PCD header")
    encoding = lines["DATA"][0].lower()
    if encoding not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"DATA {encoding}; expected ascii, binary or binary_compressed")
    names = tuple(lines["FIELDS"])
    width, height = _whole(lines, "WIDTH", None), _whole(lines, "HEIGHT", 1)
    points = _whole(lines, "POINTS", None if width is None else width * (height or 1))
    if points is None:
        raise ValueError("no line POINTS or WIDTH in the header; expected the number of points")
    if width is None or width * (height or 1) != points:
        width, height = points, 1
    return Header(names, _row_type(lines, names), width, height or 1, " ".join(lines.get("VIEWPOINT", [])), encoding), position


def _whole(lines: dict[str, list[str]], name: str, default: int | None) -> int | None:
    if name not in lines:
        return default
    if len(lines[name]) != 1 or not lines[name][0].isdecimal():
        raise ValueError(f"{name} {' '.join(lines[name])}; expected a number")
    return int(lines[name][0])


def _row_type(lines: dict[str, list[str]], names: tuple[str, ...]) -> np.dtype:
    counts = lines.get("COUNT", ["1"] * len(names))
    if not len(names) == len(lines["SIZE"]) == len(lines["TYPE"]) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT of different lengths; expected one word for each field")
    fields = []
    for i, (name, size, kind, count) in enumerate(zip(names, lines["SIZE"], lines["TYPE"], counts, strict=True)):
        allowed = ("4", "8") if kind.upper() == "F" else ("1", "2", "4", "8")
        if kind.upper() not in _KINDS or size not in allowed or not count.isdecimal() or len(count) > 6:
            raise ValueError(f"field {name} of TYPE {kind}, SIZE {size}, COUNT {count}; expected F, U or I of 1 to 8 bytes")
        unique = name if name not in names[:i] else f"{name} {i}"
        fields.append((unique, f"<{_KINDS[kind.upper()]}{size}", () if count == "1" else (int(count),)))
    return np.dtype(fields)


def _ascii(text: bytes, kind: np.dtype, count: int) -> dict[str, np.ndarray]:
    try:
        values = np.fromstring(text, sep=" ") if text.strip() else np.zeros(0)  # pyright: ignore[reportArgumentType, reportCallIssue]
    except ValueError as error:
        raise ValueError("a word among the data; expected numbers alone") from error
    widths = {name: int(np.prod(kind[name].shape)) for name in kind.names or ()}
    if len(values) != count * sum(widths.values()):
        raise ValueError(f"{len(values)} numbers; expected {count * sum(widths.values())} for {count} points")
    rows, first, columns = values.reshape(count, -1), 0, {}
    with np.errstate(invalid="ignore", over="ignore"):
        for name, width in widths.items():
            column = rows[:, first : first + width].astype(kind[name].base)
            columns[name] = column.reshape(count, *kind[name].shape)
            first += width
    return columns


def _compressed(data: memoryview, kind: np.dtype, count: int) -> dict[str, np.ndarray]:
    import lzf

    size = count * kind.itemsize
    packed, unpacked = struct.unpack_from("<II", data) if len(data) >= 8 else (0, 0)
    if packed > len(data) - 8 or unpacked != size or size > packed * _LARGEST_RATIO:
        found = f"{len(data)} bytes of data, of which {packed} unpack to {unpacked}"
        raise ValueError(f"{found}; expected {size} bytes for {count} points")
    try:
        plain = lzf.decompress(bytes(data[8 : 8 + packed]), size) or b""
    except ValueError as error:
        raise ValueError(f"damaged compressed data ({error})") from error
    if len(plain) != size:
        raise ValueError(f"{len(plain)} bytes after decompression; expected {size} for {count} points")
    columns, first = {}, 0
    for name in kind.names or ():
        columns[name] = np.frombuffer(plain, kind[name], count, first)  # all values of a field stand together
        first += count * kind[name].itemsize
    return columns


def _encode(header: Header, columns: dict[str, np.ndarray]) -> bytes:
    kinds = [columns[name].dtype for name in header.kind.names or ()]
    counts = [int(np.prod(columns[name].shape[1:])) for name in header.kind.names or ()]
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(header.names),
        "SIZE": " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE": " ".join(_LETTERS[kind.kind] for kind in kinds),
        "COUNT": " ".join(map(str, counts)),
        "WIDTH": header.width,
        "HEIGHT": header.height,
        "VIEWPOINT": header.viewpoint or "0 0 0 1 0 0 0",
        "POINTS": header.width * header.height,
        "DATA": "binary",
    }
    fields = [(name, columns[name].dtype.newbyteorder("<"), columns[name].shape[1:]) for name in header.kind.names or ()]
    rows = np.zeros(header.width * header.height, fields)
    for name, column in columns.items():
        rows[name] = column
    text = "# .PCD v0.7 - Point Cloud Data file format\n" + "".join(f"{name} {value}\n" for name, value in lines.items())
    return text.encode("latin-1") + rows.tobytes()
