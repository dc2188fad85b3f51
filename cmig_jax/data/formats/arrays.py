"""NumPy's NPY and NPZ."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass

import numpy as np

from cmig_jax.data.formats.content import (
    Parsed,
    are_normals,
    axes,
    coordinate_type,
    moved_columns,
    moved_points,
    normals_of,
    stacked,
    turned,
)

_POINTS, _NORMALS = ("points.npy", "xyz.npy"), "normals.npy"


@dataclass(frozen=True)
class Array:
    """An array of points, one a row: `[N, >= 3]`, `[H, W, >= 3]`, or structured with x, y and z."""

    values: np.ndarray

    def points(self) -> np.ndarray:
        """Return the coordinates `[P, 3]` float64."""
        if self.values.dtype.names is None:
            return np.asarray(self.values[..., :3], np.float64).reshape(-1, 3)
        columns = self._columns()
        names = axes(list(columns))
        if names is None:
            raise ValueError(f"fields {', '.join(columns)}; expected x, y and z among them")
        return stacked(columns, names)

    def normals(self) -> np.ndarray | None:
        """Return the fields of normals, or unit vectors behind x y z, `[P, 3]` float64; else None."""
        if self.values.dtype.names is not None:
            return normals_of(self._columns())
        behind = self.values[..., 3:6].reshape(-1, 3).astype(np.float64) if self.values.shape[-1] >= 6 else None
        return behind if behind is not None and are_normals(behind) else None

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode as NPY; normals of a structured array, or unit vectors behind x y z, are turned."""
        return _npy(self.moved_values(target_from_source))

    def moved_values(self, target_from_source: np.ndarray) -> np.ndarray:
        """Return the array of the same shape, moved."""
        values = self.values
        if values.dtype.names is not None:
            columns = moved_columns(self._columns(), target_from_source)
            kinds = [(name, columns[name].dtype if name in columns else values.dtype[name]) for name in values.dtype.names]
            written = np.zeros(values.shape, kinds)
            for name in values.dtype.names:
                written[name] = columns[name].reshape(values.shape) if name in columns else values[name]
            return written
        points = moved_points(self.points(), target_from_source)
        kind = np.dtype(np.float64) if values.dtype.kind != "f" else coordinate_type(points, values.dtype)
        written = values.astype(kind)
        written[..., :3] = points.reshape(*values.shape[:-1], 3)
        if values.shape[-1] >= 6 and are_normals(values[..., 3:6].reshape(-1, 3).astype(np.float64)):
            written[..., 3:6] = turned(values[..., 3:6].reshape(-1, 3), target_from_source).reshape(*values.shape[:-1], 3)
        return written

    def _columns(self) -> dict[str, np.ndarray]:
        names = self.values.dtype.names or ()
        return {name: self.values[name].reshape(-1) for name in names if self.values.dtype[name].kind in "fiu"}


@dataclass(frozen=True)
class Archive:
    """An NPZ archive: its members as bytes, and the one that holds the points."""

    members: dict[str, bytes]
    name: str
    array: Array

    def normals(self) -> np.ndarray | None:
        """Return those of the array `normals` `[P, 3]` float64, or of the points' array; else None."""
        if _NORMALS in self.members and self.name != _NORMALS:
            normals = _load(self.members[_NORMALS])
            if normals.shape == self.array.points().shape and normals.dtype.kind == "f":
                return normals.astype(np.float64)
        return self.array.normals()

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode as NPZ: points moved, an array `normals` turned, other members as they were."""
        members = {**self.members, self.name: self.array.moved(target_from_source, ".npy")}
        if _NORMALS in members and self.name != _NORMALS:
            normals = _load(members[_NORMALS])
            if normals.ndim == 2 and normals.shape[1] == 3 and normals.dtype.kind == "f":
                members[_NORMALS] = _npy(turned(normals, target_from_source).astype(normals.dtype))
        return _npz(members)


def read_npy(content: bytes, suffix: str) -> Parsed:
    """Read an NPY file (`Format.read`)."""
    array = Array(_checked(_load(content)))
    return Parsed(array.points(), None, array, normals=array.normals)


def read_npz(content: bytes, suffix: str) -> Parsed:
    """Read an NPZ archive of one array, or with one that is called points or xyz (`Format.read`)."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    arrays = [name for name in members if name.endswith(".npy")]
    lowered = {name.lower(): name for name in reversed(arrays)}
    named = [lowered[name] for name in _POINTS if name in lowered] or (arrays if len(arrays) == 1 else [])
    if not named:
        names = ", ".join(name.removesuffix(".npy") for name in arrays) or "none"
        raise ValueError(f"arrays: {names}; expected one array, or one called points or xyz")
    array = Array(_checked(_load(members[named[0]])))
    parsed = Archive(members, named[0], array)
    return Parsed(array.points(), None, parsed, normals=parsed.normals)


def encode_npy(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points `[P, 3]` float64 (`Format.encode`)."""
    return _npy(points)


def encode_npz(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points `[P, 3]` float64 as the array `points` (`Format.encode`)."""
    return _npz({"points.npy": _npy(points)})


def _load(content: bytes) -> np.ndarray:
    """Read an NPY file after comparing the declared size with the file's."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, kind = read_header(file)
    if kind.hasobject:
        raise ValueError("an array of Python objects; expected numbers")
    count, size = int(np.prod(shape, dtype=object)), len(content) - file.tell()
    if count * kind.itemsize > size:
        raise ValueError(f"{size} bytes of data; expected {count * kind.itemsize} for shape {shape}, {kind}")
    values = np.frombuffer(content, kind, count, file.tell()) if count else np.zeros(0, kind)
    return values.reshape(shape, order="F" if fortran else "C")


def _checked(values: np.ndarray) -> np.ndarray:
    """Return an array of points.

    Raises:
        ValueError: another shape or kind of numbers.
    """
    structured, transposed = values.dtype.names is not None, values.ndim == 2 and values.shape[0] == 3 < values.shape[1]
    if transposed and not structured:
        raise ValueError(f"shape {values.shape}, a row for each of x, y and z; expected a row for each point: save array.T")
    columns = values.shape[-1] >= 3 if values.ndim in (2, 3) else False
    if not structured and not (columns and values.dtype.kind in "fiu"):
        raise ValueError(f"shape {values.shape}, {values.dtype}; expected [N, 3] real numbers, or more columns, or [H, W, 3]")
    return values


def _npy(values: np.ndarray) -> bytes:
    written = io.BytesIO()
    np.lib.format.write_array(written, values, allow_pickle=False)
    return written.getvalue()


def _npz(members: dict[str, bytes]) -> bytes:
    written = io.BytesIO()
    with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return written.getvalue()
