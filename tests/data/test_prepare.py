"""Preparation: determinism, continuation, repair, full disk, size; and the errors of the reader."""

import dataclasses
import errno
import json
import pickle
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh

from cmig_jax.config import Config, DataConfig, ViewsConfig
from cmig_jax.data import prepare as preparation
from cmig_jax.data.prepare import default_prepared_folder, ensure_prepared, main, prepare
from cmig_jax.data.render import render_views
from cmig_jax.data.shards import Shards, check_settings

VIEWS = ViewsConfig(layout="axes", count=6, size=16)


@pytest.fixture(autouse=True)
def small_shards(monkeypatch):
    monkeypatch.setattr(preparation, "OBJECTS_PER_SHARD", 2)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> Path:
    """Two categories of boxes and cylinders: three to train on, two to test on, each."""
    root, rng = tmp_path_factory.mktemp("meshes"), np.random.default_rng(0)
    for split, number in (("train", 3), ("test", 2)):
        for category in ("box", "cylinder"):
            folder = root / category / split
            folder.mkdir(parents=True)
            for i in range(number):
                size = rng.uniform(0.5, 2, size=3)
                mesh = trimesh.creation.box(size) if category == "box" else trimesh.creation.cylinder(size[0], size[1], sections=12)
                mesh.export(folder / f"{category}_{i:04d}.off")
    return root


@pytest.fixture(scope="module")
def config(meshes) -> Config:
    return Config(data=DataConfig(source="meshes", root=str(meshes)), views=VIEWS)


@pytest.fixture(scope="module")
def finished(config, tmp_path_factory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "OBJECTS_PER_SHARD", 2)
        return prepare(config, tmp_path_factory.mktemp("finished") / "prepared", workers=1, progress=False)


@pytest.fixture
def prepared(finished, tmp_path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "prepared"))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_a_split_has_its_objects_in_order(finished):
    shards = Shards(finished, "train", verify="checksum")
    assert shards.categories == ("box", "cylinder")
    assert len(shards) == 6
    assert len(Shards(finished, "test")) == 4
    np.testing.assert_array_equal(np.sort(shards.labels), [0, 0, 0, 1, 1, 1])
    assert len(set(shards.names)) == 6
    for i in range(6):
        assert shards.points(i).shape == (2048, 3)
        assert shards.points(i).dtype == np.float32
        assert 0.9 < np.linalg.norm(shards.points(i), axis=1).max() <= 1 + 1e-6
        views = shards.views(i)
        assert views is not None
        assert views.shape == (6, 16, 16)
        assert views.dtype == np.uint8
        assert (views.max(axis=(1, 2)) > 0).all()
    with pytest.raises(IndexError):
        shards.points(6)
    with pytest.raises(ValueError, match="read-only"):
        shards.points(0)[:] = 0


def test_points_and_views_share_their_frame(finished):
    shards = Shards(finished, "train")
    for i in range(len(shards)):
        stored, again = shards.views(i), render_views(shards.points(i), layout="axes", count=6, size=16)
        assert stored is not None
        both = (stored > 0) & (again > 0)
        assert both.sum() > 0.85 * (stored > 0).sum()
        assert np.median(np.abs(stored.astype(int) - again)[both]) <= 3


def test_the_halves_of_the_points_are_independent_samplings(finished):
    points = Shards(finished, "train").points(0)
    assert not (points[:1024, None] == points[None, -1024:]).all(axis=-1).any()


def test_shards_travel_to_other_processes(finished):
    shards = Shards(finished, "train")
    expected = shards.points(3).copy()
    sent = pickle.dumps(shards)
    assert len(sent) < 50_000, "the arrays stay on the disk"
    np.testing.assert_array_equal(pickle.loads(sent).points(3), expected)


def test_the_number_of_workers_does_not_matter(config, finished, tmp_path):
    assert contents(prepare(config, tmp_path / "two", workers=2, progress=False)) == contents(finished)


def test_a_script_that_its_workers_import_is_told_so_instead_of_waiting_for_ever(meshes, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from cmig_jax.config import Config, DataConfig\n"
        "from cmig_jax.data import prepare\n"
        "prepare.OBJECTS_PER_SHARD = 4\n"
        f"data = DataConfig(source='meshes', root={str(meshes)!r})\n"
        "prepare.prepare(Config(data=data), 'prepared', workers=2, progress=False)\n"
    )
    done = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "OSError: a process that prepared prepared has ended early" in done.stderr
    assert "if __name__ == '__main__':" in done.stderr


def test_without_views_of_the_object_the_points_are_the_same(config, finished, tmp_path):
    observed = dataclasses.replace(config, views=dataclasses.replace(VIEWS, of="both"))
    shards = Shards(prepare(observed, tmp_path / "points", workers=1, progress=False), "train")
    assert shards.views(0) is None
    np.testing.assert_array_equal(shards.points(5), Shards(finished, "train").points(5))
    check_settings(finished, observed)
    with pytest.raises(ValueError, match=r"views\.of = object, but .* views\.of = source"):
        check_settings(tmp_path / "points", config)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(errno.EIO, "broken")])
def test_an_interrupted_preparation_continues(config, finished, tmp_path, monkeypatch, error):
    out, calls = tmp_path / "prepared", []

    def interrupted(*args, **flags):
        calls.append(args)
        if len(calls) == 6:
            raise error
        return render_views(*args, **flags)

    with monkeypatch.context() as patch:
        patch.setattr(preparation, "render_views", interrupted)
        with pytest.raises((KeyboardInterrupt, OSError)):
            prepare(config, out, workers=1, progress=False)
    assert not (out / "manifest.json").exists()
    assert {path.name for path in out.glob("*.points.npy")} == {"train-00000.points.npy", "train-00001.points.npy"}
    with pytest.raises(ValueError, match="not prepared to its end"):
        Shards(out, "train")
    (out / "train-00002.points.npy.partial").write_bytes(b"of a killed process")
    before = (out / "train-00000.views.npy").stat().st_mtime_ns
    prepare(config, out, workers=1, progress=False)
    assert contents(out) == contents(finished)
    assert (out / "train-00000.views.npy").stat().st_mtime_ns == before, "finished shards are not made again"


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
def test_a_damaged_shard_is_named_and_its_command_repairs_it(prepared, finished, capsys, name, damage, fault):
    damage(prepared / name)
    with pytest.raises(ValueError, match=fault) as caught:
        Shards(prepared, name.split("-")[0], verify="checksum")
    assert str(prepared / name) in str(caught.value)
    command = shlex.split(str(caught.value).split("repair it with: ")[1])
    assert command[:3] == ["python", "-m", "cmig_jax.data.prepare"]
    assert main([*command[3:], "--verify"]) == 2
    kept = (prepared / "test-00001.points.npy").stat().st_mtime_ns
    assert main([*command[3:], "--workers", "1"]) == 0
    assert contents(prepared) == contents(finished)
    assert (prepared / "test-00001.points.npy").stat().st_mtime_ns == kept
    assert main(["--out", str(prepared), "--verify"]) == 0
    assert "10 objects" in capsys.readouterr().out


def test_a_size_is_checked_without_reading_the_file(prepared):
    truncate(prepared / "train-00000.views.npy")
    with pytest.raises(ValueError, match="bytes instead of"):
        Shards(prepared, "train")
    Shards(prepared, "test")


def test_an_unreadable_shard_is_named_on_use(prepared):
    shards = Shards(prepared, "train")
    (prepared / "train-00000.views.npy").unlink()
    with pytest.raises(ValueError, match=r"train-00000.views.npy cannot be read .* repair it with"):
        shards.views(0)


def test_a_full_disk_leaves_nothing_half_written(config, finished, tmp_path, monkeypatch):
    out = tmp_path / "prepared"

    def full(file, array):
        file.write(b"some bytes")
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(preparation.np, "save", full)
        with pytest.raises(OSError, match=rf"{out}: the disk is full: 49152 bytes needed .* \d+ free"):
            prepare(config, out, workers=1, progress=False)
    assert list(out.iterdir()) == []
    assert contents(prepare(config, out, workers=1, progress=False)) == contents(finished)


def test_too_little_space_is_said_beforehand(config, tmp_path, monkeypatch, capsys):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(preparation.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    needed = 10 * (2048 * 12 + 6 * 16 * 16)
    with pytest.raises(OSError, match=rf"{tmp_path / 'prepared'}: {needed} bytes needed, 1000 free") as caught:
        prepare(config, tmp_path / "prepared", progress=False)
    assert caught.value.errno == errno.ENOSPC
    assert list((tmp_path / "prepared").iterdir()) == []


def test_modelnet40_at_full_size_fits_in_13_gb():
    job = preparation._Job(Path(), "train-00000", {}, 2048, Config().views, tuple(range(12_311)), None)
    assert sum(job.file_bytes().values()) < 13e9


def test_other_settings_are_refused_by_name(config, finished, tmp_path):
    larger = dataclasses.replace(config, views=dataclasses.replace(VIEWS, size=32))
    with pytest.raises(ValueError, match=r"views\.size = 32, but .* views\.size = 16"):
        check_settings(finished, larger)
    with pytest.raises(ValueError, match=r"views\.size = 32, but .* views\.size = 16"):
        prepare(larger, finished, workers=1, progress=False)
    twice = dataclasses.replace(config, data=dataclasses.replace(config.data, points=1500, sampling="twice"))
    with pytest.raises(ValueError, match=r"data\.points = 1500 .* needs 3000 points of every object, but .* 2048"):
        check_settings(finished, twice)
    check_settings(finished, dataclasses.replace(config, data=dataclasses.replace(config.data, points=1500)))
    with pytest.raises(ValueError, match=r"split 'validation' .* train, test"):
        Shards(finished, "validation")


def test_ensure_prepared_prepares_once_in_a_folder_of_its_settings(config, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few = dataclasses.replace(config, data=dataclasses.replace(config.data, points=512))
    assert default_prepared_folder(config) == default_prepared_folder(few), "512 points are the first of 1,024"
    assert default_prepared_folder(config) != default_prepared_folder(dataclasses.replace(config, views=ViewsConfig()))
    made = []
    monkeypatch.setattr(preparation, "prepare", lambda *args: made.append(prepare(*args, workers=1, progress=False)))
    folder = ensure_prepared(config)
    assert folder.parent == Path("data")
    assert ensure_prepared(few) == folder
    assert len(made) == 1
    named = dataclasses.replace(config, data=dataclasses.replace(config.data, prepared=str(folder)))
    assert ensure_prepared(named) == folder


def test_hdf5_clouds_keep_their_order(tmp_path):
    root, rng = tmp_path / "raw", np.random.default_rng(0)
    root.mkdir()
    (root / "shape_names.txt").write_text("ball\nbox\n")
    clouds = {}
    for split, number in (("train", 3), ("test", 2)):
        clouds[split] = rng.normal(size=(number, 2048, 3)).astype(np.float32)
        with h5py.File(root / f"ply_data_{split}0.h5", "w") as file:
            file["data"] = clouds[split]
            file["label"] = (np.arange(number) % 2).astype(np.uint8)[:, None]
    config = Config(data=DataConfig(source="modelnet40-hdf5", root=str(root)), views=VIEWS)
    shards = Shards(prepare(config, tmp_path / "prepared", workers=1, progress=False), "train")
    assert shards.categories == ("ball", "box")
    np.testing.assert_array_equal(shards.labels, [0, 1, 0])
    for i in range(3):
        raw, stored = clouds["train"][i], shards.points(i)
        direction = (raw[100] - raw[7]) / np.linalg.norm(raw[100] - raw[7])
        np.testing.assert_allclose((stored[100] - stored[7]) / np.linalg.norm(stored[100] - stored[7]), direction, atol=1e-5)
        assert stored.shape == (2048, 3)


def test_short_clouds_begin_anew_and_are_refused_where_they_do_not_suffice(tmp_path):
    folder = tmp_path / "raw" / "thing"
    folder.mkdir(parents=True)
    for i in range(2):
        np.save(folder / f"{i}.npy", np.random.default_rng(i).normal(size=(600, 3)) * 50 + 7)
    config = Config(data=DataConfig(source="meshes", root=str(tmp_path / "raw"), prepared=str(tmp_path / "prepared")), views=VIEWS)
    with pytest.raises(ValueError, match=r"needs 1024 points of every object, but .* has objects of 600"):
        ensure_prepared(config)
    enough = dataclasses.replace(config, data=dataclasses.replace(config.data, points=512))
    points = Shards(ensure_prepared(enough), "train").points(0)
    assert points.shape == (2048, 3)
    assert len(np.unique(points[:600], axis=0)) == 600
    np.testing.assert_array_equal(points[:600], points[600:1200])


def test_generated_shapes_by_the_command_line_and_two_workers(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(preparation, "OBJECTS_PER_SHARD", 64)
    flags = ["--data.source", "shapes", "--data.shapes", "4", "--views.layout", "axes", "--views.count", "6", "--views.size", "16"]
    assert main([*flags, "--out", str(tmp_path / "prepared"), "--workers", "2"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "prepared")
    assert len(Shards(tmp_path / "prepared", "train").categories) == 40
    manifest = json.loads((tmp_path / "prepared" / "manifest.json").read_text())
    assert manifest["settings"]["data.shapes"] == 4
    assert len(Shards(tmp_path / "prepared", "train")) == manifest["objects"]["train"] == 160


@pytest.mark.parametrize("text", ["{}", '{"format": 1}', "[]"])
def test_what_is_no_manifest_is_named(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(ValueError, match=r"manifest\.json: expected a manifest of format 1"):
        Shards(tmp_path, "train")


@pytest.mark.parametrize(
    "flags",
    [
        ["--data.source", "meshes", "--data.root", "no/such/folder"],
        ["--data.source", "shapes", "--workers", "0"],
        ["--data.source", "meshes"],
        ["--views.count", "7"],
        ["--verify", "--out", "no/such/folder"],
    ],
)
def test_bad_input_exits_with_2_and_one_line(flags, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(flags) == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("error: ")
    assert "\n" not in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("flags", "code"), [(["--help"], 0), (["--views.cuont", "6"], 2), (["--views.size", "big"], 2)])
def test_help_and_wrong_flags(flags, code, capsys):
    with pytest.raises(SystemExit) as caught:
        main(flags)
    assert caught.value.code == code
    printed = capsys.readouterr()
    if code == 0:
        assert all(flag in printed.out for flag in ("--data.root", "--views.size", "--out", "--workers", "--verify"))
