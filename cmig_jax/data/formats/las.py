"""LAS and LAZ, by `laspy` (an extra of the package)."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from cmig_jax.data.formats.content import PRECISION, Parsed, extent, moved_points

EXTRA = "pip install 'cmig_jax[formats]'"
_HEADER = 227  # bytes of the shortest header, of LAS 1.0
_RECORD = 54  # bytes of the shortest variable length record
_CHUNK = 1_000_000
_STEPS = 2**31 - 2  # coordinates are 32-bit numbers of steps


@dataclass(frozen=True)
class Las:
    """A LAS or LAZ file as bytes, and its points `[P, 3]`."""

    content: bytes
    points: np.ndarray

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode with the source's step between coordinates where it suffices; all attributes stay."""
        data = _parsed(self.content)
        points = moved_points(self.points, target_from_source)
        return _written(data, points, np.asarray(data.header.scales), suffix)


def read_las(content: bytes, suffix: str) -> Parsed:
    """Read a LAS or LAZ file (`Format.read`)."""
    data = _parsed(content)
    points = np.stack([np.asarray(data.x), np.asarray(data.y), np.asarray(data.z)], axis=-1).astype(np.float64)
    return Parsed(points, None, Las(content, points))


def encode_las(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points (`Format.encode`) in steps of a millionth of their extent or less."""
    laspy = _laspy()
    data = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    data.points = laspy.ScaleAwarePointRecord.zeros(len(points), header=data.header)
    step = 10.0 ** np.floor(np.log10((extent(points) or 1.0) * PRECISION))
    return _written(data, points, np.full(3, step), suffix)


def _laspy() -> Any:
    try:
        import laspy
    except ImportError as error:
        raise ValueError(f"LAS and LAZ need laspy: {EXTRA}") from error
    return laspy


def _check_size(content: bytes) -> None:
    """Raise ValueError if the file is not LAS, or shorter than its header says."""
    if len(content) < _HEADER or not content.startswith(b"LASF"):
        raise ValueError(f"{len(content)} bytes that begin with {content[:4]!r}; expected LASF and a header of {_HEADER} bytes or more")
    start, records, kind, size, count = struct.unpack_from("<IIBHI", content, 96)
    used = records * _RECORD
    if content[25] >= 4 and len(content) >= 255:  # LAS 1.4
        records, many = struct.unpack_from("<IQ", content, 243)
        used, count = used + records * _RECORD, many or count
    if used > len(content):
        raise ValueError(f"{used} bytes of variable length records in a file of {len(content)}; expected fewer")
    if not kind & 0x80 and len(content) - start < count * size:  # the highest bit says that points are compressed
        raise ValueError(f"{max(0, len(content) - start)} bytes of points; expected {count * size} for {count} points")


def _parsed(content: bytes) -> Any:
    """Return laspy's `LasData`; points are decompressed in pieces, so that no more memory is taken than they need."""
    laspy = _laspy()
    _check_size(content)
    with laspy.open(io.BytesIO(content)) as reader:
        pieces = [piece.array for piece in reader.chunk_iterator(_CHUNK)]
        header = reader.header
    rows = np.concatenate(pieces) if pieces else np.zeros(0, header.point_format.dtype())
    if len(rows) != header.point_count:
        raise ValueError(f"{len(rows)} points; expected {header.point_count}")
    return laspy.LasData(header, laspy.ScaleAwarePointRecord(rows, header.point_format, header.scales, header.offsets))


def _written(data: Any, points: np.ndarray, steps: np.ndarray, suffix: str) -> bytes:
    """Encode `LasData` with other coordinates: an offset near them, and steps so large that they fit."""
    offsets = np.floor(points.min(axis=0))
    steps = np.maximum(steps, np.ptp(points, axis=0) / _STEPS)
    rows = data.points.array.copy()
    for i, name in enumerate("XYZ"):
        rows[name] = np.round((points[:, i] - offsets[i]) / steps[i])
    data.header.scales, data.header.offsets = steps, offsets
    data.points = _laspy().ScaleAwarePointRecord(rows, data.header.point_format, steps, offsets)
    data.update_header()
    written = io.BytesIO()
    data.write(written, do_compress=suffix == ".laz")
    return written.getvalue()
