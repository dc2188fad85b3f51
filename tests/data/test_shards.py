"""Prepared folders: the reader, interruption, damage and repair, a full disk, and settings that do not agree."""

import errno
import json
import pickle
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data import prepare as preparation
from cmig_jax.data import shard_jobs
from cmig_jax.data.prepare import prepare
from cmig_jax.data.render import render_views
from cmig_jax.data.shards import FORMAT, LOCK, Shards, check_settings

VIEWS = ViewsConfig(layout="axes", count=6, size=16)

pytestmark = pytest.mark.usefixtures("small_shards")


@pytest.fixture
def data(meshes) -> DataConfig:
    return DataConfig(source="meshes", root=str(meshes))


@pytest.fixture
def prepared(prepared_meshes, tmp_path) -> Path:
    """A copy that may be changed."""
    return Path(shutil.copytree(prepared_meshes, tmp_path / "prepared"))


def test_arrays_are_read_only_and_stay_on_the_disk(prepared_meshes):
    shards = Shards(prepared_meshes, "train")
    expected = shards.points(3).copy()
    sent = pickle.dumps(shards)
    assert len(sent) < 50_000, "only the names of the files travel to other processes"
    np.testing.assert_array_equal(pickle.loads(sent).points(3), expected)
    with pytest.raises(ValueError, match="read-only"):
        shards.points(0)[:] = 0
    with pytest.raises(IndexError):
        shards.points(6)
    with pytest.raises(ValueError, match=r"split 'validation' .* train, test"):
        Shards(prepared_meshes, "validation")


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(errno.EIO, "broken")])
def test_an_interrupted_preparation_continues(data, prepared_meshes, contents, tmp_path, monkeypatch, error):
    out, calls = tmp_path / "prepared", []

    def interrupted(*args, **flags):
        calls.append(args)
        if len(calls) == 6:
            raise error
        return render_views(*args, **flags)

    with monkeypatch.context() as patch:
        patch.setattr(shard_jobs, "render_views", interrupted)
        with pytest.raises((KeyboardInterrupt, OSError)):
            prepare(data, VIEWS, out, workers=1, progress=False)
    assert not (out / "manifest.json").exists()
    assert {path.name for path in out.glob("*.points.npy")} == {"train-00000.points.npy", "train-00001.points.npy"}
    with pytest.raises(ValueError, match=r"manifest\.json is missing: expected a prepared folder"):
        Shards(out, "train")
    with pytest.raises(ValueError, match=r"views\.size = 32, but .* was prepared with views\.size = 16: choose another folder"):
        prepare(data, replace(VIEWS, size=32), out, workers=1, progress=False)
    before = (out / "train-00000.views.npy").stat().st_mtime_ns
    prepare(data, VIEWS, out, workers=1, progress=False)
    assert contents(out) == contents(prepared_meshes)
    assert (out / "train-00000.views.npy").stat().st_mtime_ns == before, "complete shards are not made again"


def test_what_a_killed_process_left_is_removed(meshes, data, prepared_meshes, contents, tmp_path):
    """The process ends between writing its second file and renaming it."""
    out, script = tmp_path / "prepared", tmp_path / "script.py"
    script.write_text(
        "import os, pathlib\n"
        "from cmig_jax.config import DataConfig, ViewsConfig\n"
        "from cmig_jax.data import prepare\n"
        "prepare.OBJECTS_PER_SHARD, rename = 2, pathlib.Path.replace\n"
        "pathlib.Path.replace = lambda path, to: os._exit(9) if 'views' in str(to) else rename(path, to)\n"
        f"data = DataConfig(source='meshes', root={str(meshes)!r})\n"
        f"prepare.prepare(data, ViewsConfig(layout='axes', count=6, size=16), {str(out)!r}, workers=1, progress=False)\n"
    )
    assert subprocess.run([sys.executable, script], timeout=120, check=False).returncode == 9
    (partial,) = out.glob(".*.partial.npy")
    assert partial.stat().st_size > 2 * 6 * 16 * 16
    prepare(data, VIEWS, out, workers=1, progress=False)
    assert contents(out) == contents(prepared_meshes)


def test_shards_of_another_format_are_made_again(data, prepared_meshes, contents, tmp_path):
    note = {"format": FORMAT - 1, "settings": {"data.source": "other"}, "shard": {"name": "train-00000"}}
    (tmp_path / "train-00000.json").write_text(json.dumps(note))
    assert contents(prepare(data, VIEWS, tmp_path, workers=1, progress=False)) == contents(prepared_meshes)


def test_other_files_of_the_folder_stay(data, tmp_path):
    (tmp_path / "photo-beach.json").write_text("{}")
    prepare(data, VIEWS, tmp_path, workers=1, progress=False)
    assert (tmp_path / "photo-beach.json").read_text() == "{}"


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def change(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-5] ^= 255
    path.write_bytes(bytes(content))


@pytest.mark.parametrize("name", ["train-00001.points.npy", "test-00000.views.npy"])
@pytest.mark.parametrize(
    ("damage", "fault"), [(Path.unlink, "is missing"), (truncate, r"has \d+ bytes instead of \d+"), (change, "has changed")]
)
def test_a_damaged_shard_is_named_and_its_command_repairs_it(prepared, prepared_meshes, contents, main, name, damage, fault):
    damage(prepared / name)
    with pytest.raises(ValueError, match=fault) as caught:
        Shards(prepared, name.split("-")[0], verify="checksum")
    assert str(prepared / name) in str(caught.value)
    cmig, *command = shlex.split(str(caught.value).split("repair it with: ")[1])
    assert (cmig, command[0]) == ("cmig", "prepare")
    assert main(*command, "--verify").returncode == 2
    kept = (prepared / "test-00001.points.npy").stat().st_mtime_ns
    assert main(*command, "--workers", 1).returncode == 0
    assert contents(prepared) == contents(prepared_meshes)
    assert (prepared / "test-00001.points.npy").stat().st_mtime_ns == kept
    assert "10 objects" in main("prepare", "--out", prepared, "--verify").stdout


def test_sizes_are_checked_on_opening_and_files_on_use(prepared):
    shards = Shards(prepared, "train")
    truncate(prepared / "train-00000.views.npy")
    with pytest.raises(ValueError, match="bytes instead of"):
        Shards(prepared, "train")
    Shards(prepared, "test")
    (prepared / "train-00000.views.npy").unlink()
    with pytest.raises(ValueError, match=r"train-00000.views.npy cannot be read .* repair it with: cmig prepare "):
        shards.views(0)


def test_a_full_disk_leaves_no_incomplete_file(data, prepared_meshes, contents, tmp_path, monkeypatch):
    out = tmp_path / "prepared"

    def full(file, array):
        file.write(b"some bytes")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(shard_jobs.np, "save", full)
        with pytest.raises(OSError, match=rf"{out}: the disk is full: 49152 bytes needed .* \d+ free"):
            prepare(data, VIEWS, out, workers=1, progress=False)
    assert [path.name for path in out.iterdir()] == [LOCK]
    assert contents(prepare(data, VIEWS, out, workers=1, progress=False)) == contents(prepared_meshes)


def test_too_little_space_is_an_error_before_anything_is_written(data, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(preparation.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    needed = 10 * (2048 * 24 + 6 * 16 * 16)
    with pytest.raises(OSError, match=rf"{tmp_path / 'out'}: {needed} bytes needed, 1000 free") as caught:
        prepare(data, VIEWS, tmp_path / "out", progress=False)
    assert caught.value.errno == errno.ENOSPC
    assert [path.name for path in (tmp_path / "out").iterdir()] == [LOCK]


def test_other_settings_are_refused_by_name(data, prepared_meshes, tmp_path):
    larger, twice = replace(VIEWS, size=32), replace(data, points=1500, sampling="twice")
    with pytest.raises(ValueError, match=r"views\.size = 32, but .* views\.size = 16"):
        check_settings(prepared_meshes, data, larger)
    with pytest.raises(ValueError, match=r"views\.size = 32, but .* views\.size = 16"):
        prepare(data, larger, prepared_meshes, workers=1, progress=False)
    with pytest.raises(ValueError, match=r"data\.points = 1500 .* needs 3000 points of every object, but .* 2048"):
        check_settings(prepared_meshes, twice, VIEWS)
    with pytest.raises(ValueError, match=r"data\.points = 1024 .* data\.keep_least = 0\.3 needs 2560 points of every object, but .* 2048"):
        check_settings(prepared_meshes, replace(data, points=1024, keep=0.75, crop="shared", sampling="once", keep_least=0.3), VIEWS)
    with pytest.raises(ValueError, match=r"data\.source = stanford, but .* data\.source = meshes"):
        check_settings(prepared_meshes, replace(data, source="stanford"), VIEWS)
    for same, views in ((replace(data, points=1500), VIEWS), (replace(data, root="moved"), VIEWS), (data, replace(VIEWS, of="both"))):
        check_settings(prepared_meshes, same, views)
    without = prepare(data, replace(VIEWS, of="both"), tmp_path / "out", workers=1, progress=False)
    with pytest.raises(ValueError, match=r"views\.of = object, but .* views\.of = source"):
        check_settings(without, data, VIEWS)
    assert Shards(without, "train").views(0) is None
    np.testing.assert_array_equal(Shards(without, "train").points(5), Shards(prepared_meshes, "train").points(5))


@pytest.mark.parametrize(("text", "message"), [("{}", f"format {FORMAT}"), ('{"format": 2}', ""), ("[]", ""), ("{", "is not JSON")])
def test_a_file_that_is_not_a_manifest_is_an_error(tmp_path, text, message):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=rf"manifest\.json.*{message}"):
        Shards(tmp_path, "train")


def test_generated_shapes_by_the_command_line_and_two_workers(tmp_path, monkeypatch, main):
    monkeypatch.setattr(preparation, "OBJECTS_PER_SHARD", 64)
    flags = ["--data.source", "shapes", "--data.shapes", 4, "--views.layout", "axes", "--views.count", 6, "--views.size", 16]
    assert main("prepare", *flags, "--out", tmp_path / "out", "--workers", 2).stdout.strip() == str(tmp_path / "out")
    manifest = json.loads((tmp_path / "out" / "manifest.json").read_text())
    assert manifest["settings"]["data.shapes"] == 4
    assert len(Shards(tmp_path / "out", "train")) == manifest["objects"]["train"] == 160
    assert len(manifest["categories"]) == 40
    with pytest.raises(ValueError, match=r"data\.shapes = 5, but .* data\.shapes = 4"):
        check_settings(tmp_path / "out", DataConfig(source="shapes", shapes=5), VIEWS)


@pytest.mark.parametrize("flags", ["--data.source meshes", "--data.source shapes --workers 0", "--verify --out no/such/folder"])
def test_bad_input_of_the_command_is_one_line(flags, tmp_path, monkeypatch, main):
    monkeypatch.chdir(tmp_path)
    run = main("prepare", *flags.split())
    assert run.returncode == 2
    assert run.stderr.startswith("error: ")
    assert run.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
