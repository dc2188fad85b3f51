"""Atomic writes: whatever happens, a file is the old one or the new one, and nothing else is left."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cmig_jax import files
from cmig_jax.files import remove_partial_files, replacing, replacing_path, write_text


def test_files_are_replaced_as_a_whole(tmp_path):
    path = tmp_path / "a.b.txt"
    for text in ("äöü\n", "short"):
        write_text(path, text)
        assert path.read_bytes() == text.encode()
    with replacing(path) as file:
        file.write(b"new")
        file.flush()
        assert path.read_bytes() == b"short", "not before the end"
    with replacing_path(tmp_path / "picture.png") as temporary:
        assert temporary.suffix == ".png", "some writers choose the format by it"
        assert temporary.parent == tmp_path
        temporary.write_bytes(b"pixels")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a.b.txt": b"new", "picture.png": b"pixels"}


def fail(path: Path, error: type[BaseException], *, by_path: bool) -> None:
    """Raise an error after a part of the file was written."""
    with replacing_path(path) if by_path else replacing(path) as opened:
        opened.write_bytes(b"half") if by_path else opened.write(b"half")
        raise error


@pytest.mark.parametrize("by_path", [False, True])
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("before", [{}, {"data": b"old"}])
def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path, by_path, error, before):
    for name, content in before.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(error):
        fail(tmp_path / "data", error, by_path=by_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_file_that_does_not_reach_the_disk_is_not_renamed(tmp_path, monkeypatch):
    def full(_):
        raise OSError("the disk is full")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="the disk is full"):
        write_text(tmp_path / "data", "text")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["manifest.json", "train-00000.points.npy", "plain", ".hidden"])
def test_what_a_killed_process_left_can_be_removed(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"old")
    (tmp_path / "notes.partial.txt").write_text("the user's")
    (tmp_path / "below").mkdir()
    script = (
        f"import os, pathlib\nfrom cmig_jax.files import replacing\n"
        f"with replacing(pathlib.Path({str(path)!r})) as file: file.write(b'half'); file.flush(); os._exit(9)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    assert subprocess.run([sys.executable, "-c", script], env=environment, timeout=60, check=False).returncode == 9
    assert path.read_bytes() == b"old"
    assert len(list(tmp_path.iterdir())) == 4
    remove_partial_files(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {name, "notes.partial.txt", "below"}
