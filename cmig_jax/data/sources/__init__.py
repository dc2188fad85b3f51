"""The kinds of data, `data.source`. Each file declares one or more `Source` objects; a new source is a new file and a line here."""

from __future__ import annotations

from cmig_jax.config import DataConfig
from cmig_jax.data.raw import RawDataset, RecordedDataset, Source
from cmig_jax.data.sources import meshes, modelnet40_hdf5, sevenscenes, shapes, stanford

_ALL = (
    *(shapes.SOURCE, modelnet40_hdf5.SOURCE, meshes.SOURCE),
    *(stanford.MODELS, stanford.SCANS, sevenscenes.FRAGMENTS, sevenscenes.FRAGMENT_PAIRS),
)
SOURCES: dict[str, Source] = {source.name: source for source in _ALL}


def source_of(data: DataConfig) -> Source:
    """Return the declaration of `data.source`.

    Raises:
        ValueError: there is no source of this name.
    """
    if data.source not in SOURCES:
        raise ValueError(f"data.source = {data.source}: expected one of {', '.join(SOURCES)}")
    return SOURCES[data.source]


def open_objects(data: DataConfig) -> RawDataset:
    """Open the objects of `data.source`; names and labels are read now, geometry by `RawObject.geometry`.

    Raises:
        ValueError: a missing folder or file, or one that is not as the source expects; the message names it. Or a source of recorded
            pairs, which has no objects.
    """
    source = source_of(data)
    if source.records:
        raise ValueError(
            f"data.source = {data.source} has recorded pairs, no objects: it is for evaluation only "
            f"(python evaluate.py RUN_FOLDER --data.source {data.source})"
        )
    opened = source.open(data)
    assert isinstance(opened, RawDataset), f"{source.name} opens {type(opened).__name__}; a source that records declares records=True"
    return opened


def open_recordings(data: DataConfig) -> RecordedDataset:
    """Open the recordings of `data.source`; names and poses are read now, clouds by `Recording.read`.

    Raises:
        ValueError: a source of objects, a missing folder or file, or one that is not as the source expects; the message names it.
    """
    source = source_of(data)
    if not source.records:
        expected = " or ".join(other.name for other in SOURCES.values() if other.records)
        raise ValueError(f"data.source = {data.source} has objects, no recordings: expected {expected}")
    opened = source.open(data)
    assert isinstance(opened, RecordedDataset), f"{source.name} opens {type(opened).__name__}; a source of objects declares records=False"
    return opened
