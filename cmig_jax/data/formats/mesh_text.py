"""OFF and OBJ: meshes as text, of which any may hold points alone."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass

import numpy as np
import trimesh
from trimesh.geometry import triangulate_quads

from cmig_jax.data.formats.content import Parsed, moved_points, turned, written, written_coordinates

_OFF = re.compile(r"\s*((?:ST)?C?N?OFF)\b[ \t]*(BINARY)?|\s*((?:ST)?C?N?OFF)(?=[\d-])")


@dataclass(frozen=True)
class Off:
    """An OFF file: the words of each line of a vertex and of a face, with colours behind the coordinates or corners."""

    header: str
    vertices: list[list[str]]
    faces: list[str]
    points: np.ndarray

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode with new coordinates; faces and colours stay, and normals (NOFF) are turned."""
        points = moved_points(self.points, target_from_source)
        numbers, rest = written_coordinates(points), [words[3:] for words in self.vertices]
        if "N" in self.header and len(rest) and all(len(words) >= 3 for words in rest):
            vectors = turned(np.array([words[:3] for words in rest], np.float64), target_from_source)
            rest = [[*normal, *words[3:]] for normal, words in zip(written(vectors), rest, strict=True)]
        rows = [" ".join([*number, *words]) for number, words in zip(numbers, rest, strict=True)]
        return "\n".join([self.header, f"{len(rows)} {len(self.faces)} 0", *rows, *self.faces, ""]).encode()


@dataclass(frozen=True)
class Obj:
    """An OBJ file: its lines, and the coordinates of those that begin with `v`."""

    text: str
    points: np.ndarray

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode with new numbers in the lines `v` and `vn`; all else (faces, colours, materials, groups) stays."""
        points = moved_points(self.points, target_from_source)
        numbers, lines, row = written_coordinates(points), [], 0
        for line in self.text.split("\n"):
            words = line.split()
            if words[:1] == ["v"]:
                line, row = " ".join(["v", *numbers[row], *words[4:]]), row + 1
            elif words[:1] == ["vn"] and len(words) == 4:
                normal = turned(np.array([words[1:]], np.float64), target_from_source)[0]
                line = "vn " + " ".join(f"{value:.6g}" for value in normal)
            lines.append(line)
        return "\n".join(lines).encode()


def read_off(content: bytes, suffix: str) -> Parsed:
    """Read an OFF file (`Format.read`): header and counts on one line or two, comments and blank lines anywhere."""
    text = "\n".join(line.split("#")[0] for line in content.decode("utf-8-sig", "replace").splitlines())
    begin = _OFF.match(text)
    if begin is None or begin[2]:
        raise ValueError("expected a first line OFF (as text), and a line of counts")
    lines = [line for line in text[begin.end() :].split("\n") if line.strip()]
    counts = lines[0].split() if lines else []
    if len(counts) < 2 or not all(word.isdecimal() for word in counts[:3]):
        raise ValueError(f"counts {' '.join(counts)[:60]!r}; expected the numbers of vertices and faces")
    vertices, faces = int(counts[0]), int(counts[1])
    if len(lines) - 1 < vertices + faces:
        raise ValueError(f"{len(lines) - 1} lines of data; expected {vertices} vertices and {faces} faces")
    rows = [line.split() for line in lines[1 : 1 + vertices]]
    points = _coordinates([words[:3] for words in rows])
    polygons = [line.strip() for line in lines[1 + vertices : 1 + vertices + faces]]
    header = begin[1] or begin[3]
    return Parsed(points, _triangles(polygons) if faces else None, Off(header, rows, polygons, points))


def read_obj(content: bytes, suffix: str) -> Parsed:
    """Read an OBJ file (`Format.read`): its faces, or its points if it has none."""
    if b"\0" in content:
        raise ValueError("binary data; expected the text of an OBJ file")
    text = content.decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    points = _coordinates([line.split()[1:4] for line in lines if line.split()[:1] == ["v"]])
    parsed = Obj(text, points)
    if not any(line.split()[:1] == ["f"] for line in lines):
        return Parsed(points, None, parsed)
    loaded = trimesh.load(io.BytesIO(text.encode()), file_type="obj", process=False, skip_materials=True)
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh()
    if not isinstance(loaded, trimesh.Trimesh):
        raise ValueError("no faces that can be read; expected lines `f` of three corners or more")
    return Parsed(np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces), parsed)


def encode_off(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points, and faces if there are any (`Format.encode`)."""
    lines = [] if faces is None else [f"3 {a} {b} {c}" for a, b, c in faces.tolist()]
    return Off("OFF", [[] for _ in points], lines, points).moved(np.eye(4), suffix)


def encode_obj(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode points, and faces if there are any (`Format.encode`)."""
    lines = [] if faces is None else [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    return Obj("\n".join(["v 0 0 0"] * len(points) + lines) + "\n", points).moved(np.eye(4), suffix)


def _coordinates(rows: list[list[str]]) -> np.ndarray:
    for number, words in enumerate(rows):
        if len(words) < 3:
            raise ValueError(f"vertex {number} has {len(words)} coordinates; expected 3")
    return np.array(rows, np.float64).reshape(-1, 3)


def _triangles(lines: list[str]) -> np.ndarray:
    polygons = []
    for number, line in enumerate(lines):
        words = line.split()
        corners = int(words[0])
        if len(words) < 1 + corners:
            what = "the last face" if number == len(lines) - 1 else f"face {number}"
            raise ValueError(f"{what} has {len(words) - 1} corners; expected {corners}")
        if corners > 2:
            polygons.append([int(word) for word in words[1 : 1 + corners]])
    return np.asarray(triangulate_quads(polygons), np.int64).reshape(-1, 3)
