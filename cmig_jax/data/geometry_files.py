"""One file, one geometry: OFF, OBJ, PLY, STL and NPY; and folders of such files by category.

Download: ModelNet40 (Sec. IV-B) from the Princeton ModelNet page; the unpacked folder is the root (`docs/data.md`). It comes as
`<category>/{train,test}/*.off`; some of its files run the header into the counts (`OFF490 518 0`).
"""

from __future__ import annotations

import functools
import io
import re
from pathlib import Path

import numpy as np
import trimesh

from cmig_jax.data.raw import RawDataset, RawObject, Split, check_mesh, check_points, existing_folder

SUFFIXES = (".off", ".obj", ".ply", ".stl", ".npy")
_TEST_SHARE = 0.2


def read_geometry(path: str | Path) -> trimesh.Trimesh | np.ndarray:
    """Read a mesh, or points `[P, 3]` float64 (NPY; PLY without faces), as they stand in the file.

    Raises:
        ValueError: missing, truncated, of another format, or without a surface; the message names the file.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: expected a file of {', '.join(SUFFIXES)}")
    try:
        if suffix == ".npy":
            return check_points(np.load(path, allow_pickle=False), path)
        content = path.read_bytes()
        if suffix == ".off":
            content = _separate_header(content)
            _check_off_length(content)
        if suffix == ".ply":
            _check_ply_length(content)
        loaded = trimesh.load(io.BytesIO(content), file_type=suffix[1:], process=False, skip_materials=True)
    # What trimesh raises on damaged files is open-ended: index, value, key and module errors were all seen.
    except Exception as error:
        message = str(error)
        raise ValueError(
            message if message.startswith(str(path)) else f"{path}: not a readable {suffix[1:].upper()} file ({message})"
        ) from error
    if isinstance(loaded, trimesh.Scene):
        loaded = loaded.to_mesh() if loaded.geometry else trimesh.Trimesh()
    if isinstance(loaded, trimesh.PointCloud) and suffix == ".ply":
        return check_points(np.asarray(loaded.vertices), path)
    return check_mesh(loaded if isinstance(loaded, trimesh.Trimesh) else trimesh.Trimesh(), path)


def open_meshes(root: str | None) -> RawDataset:
    """Open a folder that holds one folder per category.

    A category holds `train/` and `test/`, or files directly; then the last 20 % of them by name, at least one, are the test split.

    Raises:
        ValueError: no such folder, no categories in it, or a category with fewer than two objects or an empty split.
    """
    folder = existing_folder(root, "a folder that holds a folder of meshes or clouds for each category")
    categories = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith((".", "__")))
    if not categories:
        raise ValueError(f"{folder}: no folders in it; expected one for each category, with files of {', '.join(SUFFIXES)}")
    objects = [item for label, category in enumerate(categories) for item in _category(category, label)]
    objects.sort(key=lambda item: item.split != "train")
    return RawDataset(tuple(category.name for category in categories), tuple(objects), "meshes")


def geometry_files(folder: Path) -> list[Path]:
    """List the meshes and clouds that lie directly in a folder, by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file() and not p.name.startswith("."))


def _category(folder: Path, label: int) -> list[RawObject]:
    if (folder / "train").is_dir() or (folder / "test").is_dir():
        splits: dict[Split, list[Path]] = {
            "train": geometry_files(folder / "train") if (folder / "train").is_dir() else [],
            "test": geometry_files(folder / "test") if (folder / "test").is_dir() else [],
        }
        for split, files in splits.items():
            if not files:
                raise ValueError(f"{folder / split}: 0 objects; expected at least one file of {', '.join(SUFFIXES)}")
    else:
        files = geometry_files(folder)
        if len(files) < 2:
            raise ValueError(f"{folder}: a category with {len(files)} object(s); expected at least 2, one to train on and one to test on")
        held = max(1, round(_TEST_SHARE * len(files)))
        splits = {"train": files[:-held], "test": files[-held:]}
    return [
        RawObject(str(path.relative_to(folder.parent)), label, split, functools.partial(read_geometry, path))
        for split, files in splits.items()
        for path in files
    ]


def _separate_header(content: bytes) -> bytes:
    return re.sub(rb"\A\s*OFF[ \t]*(?=[\d-])", b"OFF\n", content)


def _check_off_length(content: bytes) -> None:
    """Raise where faces are missing at the end, which trimesh passes over."""
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
    """The same for ASCII PLY; binary PLY is checked by trimesh."""
    header, separator, data = content.partition(b"end_header")
    if not separator:
        raise ValueError("no end_header")
    if b"format ascii" in header:
        expected = sum(int(count) for count in re.findall(rb"^element\s+\S+\s+(\d+)", header, re.MULTILINE))
        lines = sum(1 for line in data.splitlines() if line.strip())
        if lines < expected:
            raise ValueError(f"{lines} lines of data; expected {expected}")
