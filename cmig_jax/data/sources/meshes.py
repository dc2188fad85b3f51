"""A folder of meshes or clouds by category, such as ModelNet40's meshes.

Download: ModelNet40 (Sec. IV-B) from the Princeton ModelNet page; the unpacked folder is the root (`docs/data.md`). It comes as
`<category>/{train,test}/*.off`; in some of its files the counts follow the header on the same line (`OFF490 518 0`).
"""

from __future__ import annotations

import functools
from pathlib import Path

from cmig_jax.config import DataConfig
from cmig_jax.data.geometry_files import SUFFIXES, geometry_files, read_object_and_normals
from cmig_jax.data.raw import RawDataset, RawObject, Source, Split, existing_folder, visible_files

_TEST_SHARE = 0.2
_MOST_NAMED = 5


def open_meshes(data: DataConfig) -> RawDataset:
    """Open a folder that holds one folder per category.

    A category holds `train/` and `test/`, or files directly; then the last 20 % of them by name, at least one, are the test split.

    Raises:
        ValueError: no such folder, no categories in it, or a category with fewer than two objects or an empty split.
    """
    folder = existing_folder(data.root, "a folder that holds a folder of meshes or clouds for each category")
    categories = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith((".", "__")))
    if not categories:
        raise ValueError(f"{folder}: no folders in it; expected one for each category, with files of {', '.join(SUFFIXES)}")
    objects = [item for label, category in enumerate(categories) for item in _category(category, label)]
    objects.sort(key=lambda item: item.split != "train")
    return RawDataset(tuple(category.name for category in categories), tuple(objects))


def _category(folder: Path, label: int) -> list[RawObject]:
    if (folder / "train").is_dir() or (folder / "test").is_dir():
        splits: dict[Split, list[Path]] = {"train": geometry_files(folder / "train"), "test": geometry_files(folder / "test")}
        for split, files in splits.items():
            if not files:
                raise ValueError(
                    f"{folder / split}: 0 objects{_passed_over(folder / split)}; expected at least one file of {', '.join(SUFFIXES)}"
                )
    else:
        files = geometry_files(folder)
        if len(files) < 2:
            expected = f"expected at least 2 files of {', '.join(SUFFIXES)}, one to train on and one to test on"
            raise ValueError(f"{folder}: a category with {len(files)} object(s){_passed_over(folder)}; {expected}")
        held = max(1, round(_TEST_SHARE * len(files)))
        splits = {"train": files[:-held], "test": files[-held:]}
    return [
        RawObject(path.relative_to(folder.parent).as_posix(), label, split, functools.partial(read_object_and_normals, path))
        for split, files in splits.items()
        for path in files
    ]


def _passed_over(folder: Path) -> str:
    """Name the files of a folder that are not read, for an error."""
    read = geometry_files(folder)
    others = [path.name for path in visible_files(folder, "*") if path not in read]
    named = ", ".join(others[:_MOST_NAMED]) + (f" and {len(others) - _MOST_NAMED} more" if len(others) > _MOST_NAMED else "")
    return f" (passed over: {named})" if others else ""


SOURCE = Source("meshes", open_meshes)
