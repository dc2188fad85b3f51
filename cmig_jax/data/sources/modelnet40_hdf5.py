"""ModelNet40 as HDF5 (Sec. IV-B): `ply_data_{train,test}*.h5` with `data` `[n, 2048, 3]` and `label` `[n, 1]`, and `shape_names.txt`.

The normals of the points are read where a file has them (`normal` `[n, 2048, 3]`, as the release does).

Download: `modelnet40_ply_hdf5_2048`, the release of PointNet's authors; the unpacked folder is the root (`docs/data.md`). The points of an
object are centred, scaled to the unit sphere and in random order.
"""

from __future__ import annotations

import functools
import json
import re
from pathlib import Path

import h5py
import numpy as np

from cmig_jax.config import DataConfig
from cmig_jax.data.raw import CloudWithNormals, RawDataset, RawObject, Source, Split, existing_folder


def open_hdf5(data: DataConfig) -> RawDataset:
    """Open a folder of ModelNet40 HDF5 files; labels are read now, points by `RawObject.geometry`.

    Raises:
        ValueError: a missing folder or file, a file without `data` or `label`, wrong shapes, or a label that has no name.
    """
    folder = existing_folder(data.root, "the folder of ply_data_train*.h5, ply_data_test*.h5 and shape_names.txt")
    names = folder / "shape_names.txt"
    if not names.is_file():
        raise ValueError(f"{names}: no such file; expected the names of the categories, one a line")
    categories = tuple(line.strip() for line in names.read_text().splitlines() if line.strip())
    splits: tuple[Split, Split] = ("train", "test")
    objects = [item for split in splits for item in _split(folder, split, len(categories))]
    return RawDataset(categories, tuple(objects))


def _split(folder: Path, split: Split, categories: int) -> list[RawObject]:
    files = sorted(folder.glob(f"ply_data_{split}*.h5"), key=lambda path: (len(path.name), path.name))
    if not files:
        raise ValueError(f"{folder}: no ply_data_{split}*.h5; expected at least one")
    objects = []
    for path in files:
        labels = _labels(path, categories)
        names = _names(path, len(labels))
        reads = (functools.partial(_read_cloud, path, row) for row in range(len(labels)))
        objects += [RawObject(name, label, split, read, True) for name, label, read in zip(names, labels, reads, strict=True)]
    return objects


def _labels(path: Path, categories: int) -> list[int]:
    try:
        with h5py.File(path) as file:
            found = {key: value for key in ("data", "label") if isinstance(value := file.get(key), h5py.Dataset)}
            shapes = {key: value.shape for key, value in found.items()}
            labels = np.asarray(found["label"]).reshape(-1) if "label" in found else np.zeros(0)
            keys = sorted(file)
    except OSError as error:
        raise ValueError(f"{path}: not a readable HDF5 file ({error})") from error
    for key in ("data", "label"):
        if key not in shapes:
            raise ValueError(f"{path}: holds {keys}; expected a dataset `{key}`")
    if len(shapes["data"]) != 3 or shapes["data"][1] < 1 or shapes["data"][2] != 3:
        raise ValueError(f"{path}: data of shape {shapes['data']}; expected [n, points, 3]")
    if len(labels) != shapes["data"][0] or labels.dtype.kind not in "iu":
        raise ValueError(f"{path}: label of shape {shapes['label']}, {labels.dtype}; expected {shapes['data'][0]} whole numbers")
    wrong = labels[(labels < 0) | (labels >= categories)]
    if len(wrong):
        raise ValueError(f"{path}: label {wrong[0]}; expected 0 to {categories - 1}, the lines of shape_names.txt")
    return [int(label) for label in labels]


def _names(path: Path, count: int) -> list[str]:
    """Return the names of the objects from the list beside the file; without a list, the name of the file and the row."""
    stem = re.sub(r"(\d+)$", r"_\1", path.stem)
    lines, files = path.with_name(f"{stem}_id2name.txt"), path.with_name(f"{stem}_id2file.json")
    if lines.is_file():
        found, names = lines, [line.replace("\t", "/") for line in lines.read_text().splitlines() if line.strip()]
    elif files.is_file():
        try:
            found, names = files, [str(name) for name in json.loads(files.read_text())]
        except (ValueError, TypeError) as error:
            raise ValueError(f"{files}: expected a JSON list of names ({error})") from error
    else:
        return [f"{path.name}[{row}]" for row in range(count)]
    if len(names) != count:
        raise ValueError(f"{found}: {len(names)} names; expected {count}, one for each object of {path.name}")
    return names


def _read_cloud(path: Path, row: int) -> np.ndarray | CloudWithNormals:
    try:
        points, normals = _data(path, path.stat().st_mtime_ns)
        cloud = points[row].astype(np.float32)
        return cloud if normals is None else CloudWithNormals(cloud, normals[row])
    except (OSError, KeyError, IndexError) as error:
        raise ValueError(f"{path}: row {row} of `data` cannot be read ({error}); expected an intact HDF5 file") from error


# Objects are read in order, and a file is compressed in chunks of many objects, so the last file is kept in memory (100 MB at most).
@functools.lru_cache(maxsize=1)
def _data(path: Path, modified_ns: int) -> tuple[np.ndarray, np.ndarray | None]:
    with h5py.File(path) as file:
        return np.asarray(file["data"]), np.asarray(file["normal"]) if "normal" in file else None


SOURCE = Source("modelnet40-hdf5", open_hdf5)
