"""STL, GLB and 3MF, by trimesh."""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass

import numpy as np
import trimesh

from cmig_jax.data.formats.content import Parsed, check_single_precision, moved_points
from cmig_jax.data.formats.las import EXTRA


@dataclass(frozen=True)
class Scene:
    """A scene of trimesh, with its materials, and the vertices `[P, 3]` of all its parts."""

    scene: trimesh.Scene
    points: np.ndarray

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode the moved scene; GLB and STL have single precision alone."""
        if suffix != ".3mf":
            check_single_precision(moved_points(self.points, target_from_source), suffix, ".ply, .off or .obj")
        scene = self.scene.copy()
        scene.apply_transform(target_from_source)
        return _exported(scene, suffix)


def read_scene(content: bytes, suffix: str) -> Parsed:
    """Read an STL, GLB or 3MF file (`Format.read`)."""
    if suffix == ".stl":
        _check_stl(content)
    if suffix == ".3mf":
        _check_3mf_libraries()
    loaded = trimesh.load(io.BytesIO(content), file_type=suffix[1:], process=False)
    scene = loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    unit = scene.units if suffix in (".3mf", ".glb") else None
    if not parts:
        clouds = [np.asarray(part.vertices) for part in scene.dump() if isinstance(part, trimesh.PointCloud)]
        if not clouds:
            raise ValueError("no triangles; expected a mesh")
        points = np.concatenate(clouds).astype(np.float64)
        return Parsed(points, None, Scene(scene, points), unit)
    firsts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    points = np.concatenate([np.asarray(part.vertices, np.float64) for part in parts])
    faces = np.concatenate([np.asarray(part.faces) + first for part, first in zip(parts, firsts[:-1], strict=True)])
    return Parsed(points, faces, Scene(scene, points), unit)


def encode_scene(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode a mesh (`Format.encode`); these formats hold no clouds."""
    if faces is None:
        raise ValueError(f"{suffix[1:].upper()} holds meshes, and the source has no faces; expected a file of .ply, .xyz or .npy")
    mesh = trimesh.Trimesh(points, faces, process=False)
    return Scene(trimesh.Scene(mesh), points).moved(np.eye(4), suffix)


def _exported(scene: trimesh.Scene, suffix: str) -> bytes:
    if suffix == ".3mf":
        _check_3mf_libraries()
    written = scene.to_mesh().export(file_type="stl") if suffix == ".stl" else scene.export(file_type=suffix[1:])
    if not isinstance(written, bytes):
        raise TypeError(f"trimesh wrote {type(written)} for {suffix}; expected bytes")
    unit = (scene.units or "millimeter").removesuffix("s")  # trimesh names GLB's unit meters
    return _with_unit(written, unit) if suffix == ".3mf" and unit != "millimeter" else written


def _with_unit(content: bytes, unit: str) -> bytes:
    """Return a 3MF file with another unit than the one that trimesh always writes."""
    changed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(changed, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            member = old.read(name)
            new.writestr(name, member.replace(b'unit="millimeter"', f'unit="{unit}"'.encode(), 1) if name.endswith(".model") else member)
    return changed.getvalue()


def _check_stl(content: bytes) -> None:
    """Raise ValueError for a file that ends early."""
    if content.lstrip()[:5].lower() == b"solid" and (b"facet" in content[:4096] or b"endsolid" in content):
        if b"endsolid" not in content[-4096:]:
            raise ValueError("no line endsolid; expected one at the end")
        return
    count = int.from_bytes(content[80:84], "little")
    if len(content) < 84 + 50 * count:
        raise ValueError(f"{max(0, len(content) - 84)} bytes of triangles; expected {50 * count} for {count}")


def _check_3mf_libraries() -> None:
    try:
        import lxml
        import networkx  # noqa: F401
    except ImportError as error:
        raise ValueError(f"3MF needs lxml and networkx: {EXTRA}") from error
    del lxml
