"""Reading one geometry from one file, and writing it moved: point clouds and meshes, each also compressed (`.gz`)."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from cmig_jax.clouds import check_cloud
from cmig_jax.data.formats import arrays, las, mesh_text, pcd, ply, scenes, text, velodyne
from cmig_jax.data.formats.content import Content, Format, Parsed, moved_points, without_normals
from cmig_jax.data.raw import CloudWithNormals, check_mesh, visible_files
from cmig_jax.files import replacing

_TEXT, _SCENE = Format(text.read_text, text.encode_text), Format(scenes.read_scene, scenes.encode_scene)
_LAS = Format(las.read_las, las.encode_las)
FORMATS = {
    ".ply": Format(ply.read_ply, ply.encode_ply),
    ".pcd": Format(pcd.read_pcd, pcd.encode_pcd),
    **dict.fromkeys((".xyz", ".txt", ".csv", ".asc", ".pts"), _TEXT),
    **dict.fromkeys((".las", ".laz"), _LAS),
    ".npy": Format(arrays.read_npy, arrays.encode_npy),
    ".npz": Format(arrays.read_npz, arrays.encode_npz),
    ".bin": Format(velodyne.read_bin, velodyne.encode_bin),
    ".pcd.bin": Format(velodyne.read_pcd_bin, velodyne.encode_bin),
    ".off": Format(mesh_text.read_off, mesh_text.encode_off),
    ".obj": Format(mesh_text.read_obj, mesh_text.encode_obj),
    **dict.fromkeys((".stl", ".glb", ".3mf"), _SCENE),
}
"""How files are read and written, by suffix."""
SUFFIXES = tuple(FORMATS)
OTHER_USES = (".txt", ".csv", ".bin")
_SIGNATURES = {
    b"ply": ".ply",
    b"# .PCD": ".pcd",
    b"LASF": ".las",
    b"\x93NUMPY": ".npy",
    b"glTF": ".glb",
    b"\x1f\x8b": ".gz",
    b"OFF": ".off",
}


@dataclass(frozen=True)
class GeometryFile:
    """A geometry with all that its file says.

    Attributes:
        path: the file.
        points: `[P, 3]` float64, finite: the cloud, or the vertices of the mesh.
        mesh: with a surface; None for a cloud.
        dropped: number of rows that were left out since they are not finite.
        content: the file, with the attributes and rows that `points` lacks.
        unit: name of the unit where the file says it (3MF, GLB); it is not applied.
        normals: function that reads the normals `[rows, 3]` of every row of the file; it returns None for a file without them.
    """

    path: Path
    points: np.ndarray
    mesh: trimesh.Trimesh | None
    dropped: int
    content: Content
    unit: str | None = None
    normals: Callable[[], np.ndarray | None] = without_normals

    @property
    def geometry(self) -> trimesh.Trimesh | np.ndarray:
        """The mesh, or the points of a cloud."""
        return self.points if self.mesh is None else self.mesh


def read_geometry(path: str | Path, invalid: Literal["error", "drop"] = "error") -> GeometryFile:
    """Read a cloud or a mesh, as it stands in the file.

    Args:
        path: a file of one of `SUFFIXES`, in any case, or with `.gz` behind.
        invalid: whether rows that are not finite are an error or left out (with the faces at them).

    Raises:
        ValueError: a folder, or a file that is damaged, empty, of another format, or without points; the message names it.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    suffix = suffix_of(path)
    if path.is_dir():
        raise ValueError(f"{path}: a folder; expected a file of {', '.join(SUFFIXES)}, or one of them with .gz")
    if suffix is None:
        raise ValueError(f"{path}: expected a file of {', '.join(SUFFIXES)}, or one of them with .gz")
    content = path.read_bytes()
    try:
        if path.suffix.lower() == ".gz":
            content = gzip.decompress(content)
        if not content:
            raise ValueError("an empty file")
        parsed = FORMATS[suffix].read(content, suffix)
    # On damaged files the libraries raise errors of many types, among them IndexError, KeyError and ImportError.
    except Exception as error:
        raise ValueError(f"{path}: not a readable {suffix[1:].upper()} file ({_said(error)}){_looks_like(content, suffix)}") from error
    return _checked(path, parsed, invalid)


def read_object(path: str | Path) -> trimesh.Trimesh | np.ndarray:
    """Read a mesh, or the points `[P, 3]` float64 of a cloud (`read_geometry` says what raises)."""
    return read_geometry(path).geometry


def read_object_and_normals(path: str | Path) -> trimesh.Trimesh | np.ndarray | CloudWithNormals:
    """Read a mesh or a cloud as `read_object`; a cloud whose file has normals, with them."""
    file = read_geometry(path)
    normals = None if file.mesh is not None else file.normals()
    return file.geometry if normals is None else CloudWithNormals(file.points, normals)


def write_moved(path: str | Path, source: GeometryFile, target_from_source: np.ndarray) -> None:
    """Write a geometry moved by a matrix, in the format that the path's suffix says.

    In the format of the source, attributes, colours, faces and all rows are kept, and normals are turned. In another
    format it is the finite points, and the faces where the format has them.

    Args:
        path: a file of one of `SUFFIXES`, or with `.gz` behind; it is replaced as a whole.
        source: what `read_geometry` returned.
        target_from_source: `[4, 4]`, rigid.

    Raises:
        ValueError: a suffix that cannot be written, or a format that cannot hold the geometry or its coordinates.
    """
    path, matrix = Path(path), np.asarray(target_from_source, np.float64)
    suffix, kind = suffix_of(path), suffix_of(source.path)
    if suffix is None or kind is None:
        raise ValueError(f"{path}: expected a file of {', '.join(SUFFIXES)}, or one of them with .gz")
    try:
        if FORMATS[suffix].read is FORMATS[kind].read:
            content = source.content.moved(matrix, suffix)
        else:
            faces = None if source.mesh is None else np.asarray(source.mesh.faces)
            content = FORMATS[suffix].encode(moved_points(source.points, matrix), faces, suffix)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    with replacing(path) as file:
        file.write(gzip.compress(content, mtime=0) if path.suffix.lower() == ".gz" else content)


def suffix_of(path: Path) -> str | None:
    """Return the one of `SUFFIXES` that a path ends with, apart from `.gz`; None if there is none."""
    name = path.name.lower().removesuffix(".gz")
    return max((suffix for suffix in SUFFIXES if name.endswith(suffix)), key=len, default=None)


def geometry_files(folder: Path) -> list[Path]:
    """List the meshes and clouds in a folder, by name, without those of its sub-folders; none if there is no such folder.

    Files of suffixes that are in use for much else (`OTHER_USES`) count only in a folder without others.
    """
    files = [path for path in visible_files(folder, "*") if suffix_of(path)]
    return [path for path in files if suffix_of(path) not in OTHER_USES] or files


def _checked(path: Path, parsed: Parsed, invalid: Literal["error", "drop"]) -> GeometryFile:
    points, faces = np.ascontiguousarray(parsed.points, np.float64), parsed.faces
    finite = np.isfinite(points).all(axis=1)
    dropped = int((~finite).sum()) if invalid == "drop" else 0
    if dropped == len(points) > 0:
        raise ValueError(f"{path}: none of {len(points)} points is finite; expected some")
    if faces is not None and len(faces):
        if faces.min() < 0 or faces.max() >= len(points):
            raise ValueError(f"{path}: a face of vertex {faces.max()}; expected 0 to {len(points) - 1}")
        mesh = trimesh.Trimesh(points, faces, process=False)
        if dropped:
            mesh.update_faces(np.take(finite, faces).all(axis=1))
            mesh.update_vertices(finite)
        mesh = check_mesh(mesh, path)
        return GeometryFile(path, np.asarray(mesh.vertices, np.float64), mesh, dropped, parsed.content, parsed.unit)
    try:
        cloud = check_cloud(points[finite] if dropped else points, path)
    except ValueError as error:
        hint = "" if finite.all() else '; invalid="drop" (cmig register --drop-invalid) leaves them out'
        raise ValueError(f"{error}{hint}") from error
    return GeometryFile(path, cloud, None, dropped, parsed.content, parsed.unit, parsed.normals)


def _said(error: Exception) -> str:
    if isinstance(error, EOFError | gzip.BadGzipFile | zlib.error):
        return f"damaged compression: {error}"
    return str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"


def _looks_like(content: bytes, suffix: str) -> str:
    """Say which other format the content begins like, if one."""
    for signature, other in _SIGNATURES.items():
        if content.startswith(signature) and (other not in FORMATS or FORMATS[other].read is not FORMATS[suffix].read):
            return f"; it begins like a file of {other}"
    return ""
