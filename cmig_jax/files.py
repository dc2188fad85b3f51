"""Atomic writes: a file is replaced as a whole, or not at all; and the errors of a damaged file."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

MARK = ".partial"
DAMAGED = (OSError, EOFError, ValueError, KeyError, RuntimeError, tokenize.TokenError, zipfile.BadZipFile, zlib.error)
"""What NumPy raises for a damaged file or archive, depending on the byte."""


@contextlib.contextmanager
def replacing_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path with the same suffix and rename it to `path` at the end; on an error remove it."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{MARK}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file, then flush it to the disk and rename it to `path`; on an error remove it."""
    with replacing_path(path) as temporary, temporary.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically."""
    with replacing(path) as file:
        file.write(text.encode())


def remove_partial_files(folder: Path) -> None:
    """Remove the temporary files that killed processes left in a folder; for a folder that no other process writes to."""
    for path in folder.glob(f".*{MARK}*"):
        path.unlink(missing_ok=True)


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
