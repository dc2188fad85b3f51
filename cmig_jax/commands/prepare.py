"""`cmig prepare --data.source SOURCE --data.root FOLDER`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cmig_jax.commands import Stopped
from cmig_jax.commands.parsing import parser_of
from cmig_jax.config import DataConfig, ViewsConfig


@dataclass(frozen=True)
class Command:
    """Prepare objects, or with `--verify` check a prepared folder. Continues where it stopped; repairs what has changed."""

    data: DataConfig = field(default_factory=DataConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
    out: Path | None = None
    """The folder to fill (default: data.prepared, else a folder under data/ named after the settings)."""
    workers: int | None = None
    """Processes (default: one per core)."""
    verify: bool = False
    """Only compare every file with its checksum; write nothing."""


parse = parser_of(Command)


def run(command: Command) -> int:
    """Prepare, or verify.

    Raises:
        Stopped: it was interrupted.
    """
    from cmig_jax.data.prepare import prepare, prepared_folder
    from cmig_jax.data.shards import Shards, read_manifest

    out = command.out or prepared_folder(command.data, command.views)
    if command.verify:
        objects = sum(len(Shards(out, split, verify="checksum")) for split in read_manifest(out)["splits"])
        print(f"{out}: {objects} objects, every file is as it was written")
        return 0
    try:
        print(prepare(command.data, command.views, out, workers=command.workers))
    except KeyboardInterrupt as error:
        raise Stopped("interrupted: finished shards stay; the same command continues") from error
    return 0
