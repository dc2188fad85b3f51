"""Reading one geometry from one file: OFF, OBJ, PLY, STL and NPY."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
import trimesh

from cmig_jax.clouds import check_cloud
from cmig_jax.data.raw import check_mesh, visible_files

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".npy")


def read_geometry(path: str | Path) -> trimesh.Trimesh | np.ndarray:
    """Read a mesh, or points `[P, 3]` float64 (NPY; PLY without faces), as they stand in the file.

    Raises:
        ValueError: the file is missing, truncated, of another format, or without a surface; the message names it.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: expected a file of {', '.join(SUFFIXES)}")
    try:
        if suffix == ".npy":
            return check_cloud(np.load(path, allow_pickle=False), path)
        content = path.read_bytes()
        if suffix == ".off":
            content = _separate_header(content)
            _check_off_length(content)
        if suffix == ".ply":
            _check_ply_length(content)
        loaded = trimesh.load(io.BytesIO(content), file_type=suffix[1:], process=False, skip_materials=True)
    # On damaged files trimesh raises errors of many types, among them IndexError, ValueError, KeyError and ImportError.
    except Exception as error:
        message = str(error)
        raise ValueError(
            message if message.startswith(str(path)) else f"{path}: not a readable {suffix[1:].upper()} file ({message})"
        ) from error
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh() if loaded.geometry else trimesh.Trimesh()
    if isinstance(loaded, trimesh.PointCloud) and suffix == ".ply":
        return check_cloud(np.asarray(loaded.vertices), path)
    return check_mesh(loaded if isinstance(loaded, trimesh.Trimesh) else trimesh.Trimesh(), path)


def geometry_files(folder: Path) -> list[Path]:
    """List the meshes and clouds in a folder, by name, without those of its sub-folders; none if there is no such folder."""
    return [path for path in visible_files(folder, "*") if path.suffix.lower() in SUFFIXES]


def _separate_header(content: bytes) -> bytes:
    return re.sub(rb"\A\s*OFF[ \t]*(?=[\d-])", b"OFF\n", content)


def _check_off_length(content: bytes) -> None:
    """Raise ValueError if faces are missing at the end, which trimesh does not notice."""
    lines = [line for line in (raw.split(b"#")[0].strip() for raw in content.splitlines()) if line]
    if len(lines) < 2 or not lines[0].endswith(b"OFF"):
        raise ValueError("expected a first line OFF and a line of counts")
    vertices, faces = (int(word) for word in lines[1].split()[:2])
    if len(lines) < 2 + vertices + faces:
        raise ValueError(f"{len(lines) - 2} lines of data; expected {vertices} vertices and {faces} faces")
    last = lines[1 + vertices + faces].split() if faces else [b"0"]
    if len(last) < 1 + int(last[0]):
        raise ValueError(f"the last face has {len(last) - 1} corners; expected {int(last[0])}")


def _check_ply_length(content: bytes) -> None:
    """Raise ValueError if an ASCII PLY ends early; trimesh checks binary ones."""
    header, separator, data = content.partition(b"end_header")
    if not separator:
        raise ValueError("no end_header")
    if b"format ascii" in header:
        expected = sum(int(count) for count in re.findall(rb"^element\s+\S+\s+(\d+)", header, re.MULTILINE))
        lines = sum(1 for line in data.splitlines() if line.strip())
        if lines < expected:
            raise ValueError(f"{lines} lines of data; expected {expected}")
