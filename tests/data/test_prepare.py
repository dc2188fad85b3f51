"""Preparation: what the points of an object are, and that they are a function of the object and the settings alone."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data import prepare as preparation
from cmig_jax.data.pairs import Pairs
from cmig_jax.data.prepare import ensure_prepared, prepare, prepared_folder
from cmig_jax.data.raw import RawDataset, RawObject, Source
from cmig_jax.data.render import render_views
from cmig_jax.data.shard_jobs import Job
from cmig_jax.data.shards import Shards, check_settings
from cmig_jax.data.sources import SOURCES

VIEWS = ViewsConfig(layout="axes", count=6, size=16)
BOTH = replace(VIEWS, of="both")

pytestmark = pytest.mark.usefixtures("small_shards")


@pytest.fixture
def data(meshes) -> DataConfig:
    return DataConfig(source="meshes", root=str(meshes))


def write_clouds(folder: Path, *clouds: np.ndarray) -> DataConfig:
    """Write clouds of one category, the last to test on, and return flags for all points of the others."""
    (folder / "raw" / "thing").mkdir(parents=True)
    for i, cloud in enumerate(clouds):
        np.save(folder / "raw" / "thing" / f"{i}.npy", cloud)
    return DataConfig(source="meshes", root=str(folder / "raw"), prepared=str(folder / "out"), noise_std=0.0, crop="none")


def cloud(count: int) -> np.ndarray:
    return np.random.default_rng(count).normal(size=(count, 3)) * 50 + 7


def test_a_split_has_its_objects_in_order(prepared_meshes):
    shards = Shards(prepared_meshes, "train", verify="checksum")
    assert shards.categories == ("box", "cylinder")
    assert (len(shards), len(Shards(prepared_meshes, "test"))) == (6, 4)
    np.testing.assert_array_equal(shards.labels, [0, 0, 0, 1, 1, 1])
    assert shards.names[2:4] == ("box/train/box_0002.off", "cylinder/train/cylinder_0000.off")
    for i in range(6):
        points, views = shards.points(i), shards.views(i)
        assert (points.shape, points.dtype) == ((2048, 3), np.float32)
        assert 0.9 < np.linalg.norm(points, axis=1).max() <= 1 + 1e-6
        assert not (points[:1024, None] == points[None, -1024:]).all(axis=-1).any(), "two independent samplings"
        assert views is not None
        assert (views.shape, views.dtype) == ((6, 16, 16), np.uint8)
        again = render_views(points, layout="axes", count=6, size=16)
        both = (views > 0) & (again > 0)
        assert both.sum() > 0.85 * (views > 0).sum(), "points and views share their frame"
        assert np.median(np.abs(views.astype(int) - again)[both]) <= 3


def test_the_number_of_workers_does_not_matter(data, prepared_meshes, contents, tmp_path):
    assert contents(prepare(data, VIEWS, tmp_path / "two", workers=2, progress=False)) == contents(prepared_meshes)


def test_the_points_of_an_object_do_not_depend_on_the_other_objects(meshes, data, prepared_meshes, tmp_path):
    """So that its pairs do not either: see test_pairs.py."""
    for category, number in (("cylinder", (1, 2)), ("aeroplane", (0, 0))):
        folder = tmp_path / "raw" / category / "train"
        folder.mkdir(parents=True)
        for i in number:
            trimesh.creation.icosphere().export(folder / f"{category}_{i:04d}.off")
        (folder.parent / "test").symlink_to(meshes / "cylinder" / "test")
    (tmp_path / "raw" / "cylinder" / "train" / "cylinder_0001.off").write_bytes(
        (meshes / "cylinder" / "train" / "cylinder_0001.off").read_bytes()
    )
    some = Shards(prepare(replace(data, root=str(tmp_path / "raw")), VIEWS, tmp_path / "out", workers=1, progress=False), "train")
    everything = Shards(prepared_meshes, "train")
    name = "cylinder/train/cylinder_0001.off"
    pairs = [Pairs(objects, np.array([objects.names.index(name)]), data, BOTH, 0)[0] for objects in (some, everything)]
    for key in set(pairs[0]) - {"index", "label"}:
        np.testing.assert_array_equal(pairs[0][key], pairs[1][key])


def test_a_cloud_of_as_many_points_as_are_stored_is_permuted(tmp_path):
    """A file may be sorted; the first points must be a fair sample, and the first and last ones two of the whole object."""
    ordered = cloud(2048)[cloud(2048)[:, 0].argsort()]
    data = replace(write_clouds(tmp_path, ordered, ordered), sampling="twice")
    points = Shards(prepare(data, BOTH, tmp_path / "out", workers=1, progress=False), "train").points(0)
    unit = ordered - ordered.mean(0)
    unit /= np.linalg.norm(unit, axis=1).max()
    np.testing.assert_allclose(points[np.argsort(points[:, 0])], unit, atol=1e-6)
    for part in (points[:1024], points[-1024:], points[:100]):
        np.testing.assert_allclose(part.mean(0), 0, atol=0.1)
        np.testing.assert_allclose(part.std(0), unit.std(0), rtol=0.2)
    pair = Pairs(Shards(tmp_path / "out", "train"), np.array([0]), data, None, 0)[0]
    assert abs(pair["source"].mean(0) - ((pair["target"] - pair["t"]) @ pair["R"]).mean(0)).max() < 0.03
    again = Shards(prepare(data, BOTH, tmp_path / "again", workers=1, progress=False), "train")
    np.testing.assert_array_equal(again.points(0), points)


def test_clouds_of_modelnet40_keep_their_order(tmp_path):
    clouds = np.random.default_rng(0).normal(size=(2, 2048, 3)).astype(np.float32)
    (tmp_path / "shape_names.txt").write_text("ball\nbox\n")
    for split in ("train", "test"):
        with h5py.File(tmp_path / f"ply_data_{split}0.h5", "w") as file:
            file["data"], file["label"] = clouds, np.array([[1], [0]], np.uint8)
    shards = Shards(prepare(DataConfig(root=str(tmp_path)), VIEWS, tmp_path / "out", workers=1, progress=False), "train")
    assert shards.categories == ("ball", "box")
    np.testing.assert_array_equal(shards.labels, [1, 0])
    for i, raw in enumerate(clouds):
        centred = raw - raw.mean(0)
        np.testing.assert_allclose(shards.points(i), centred / np.linalg.norm(centred, axis=1).max(), atol=1e-6)


@pytest.mark.parametrize("sampling", ["twice", "subsets"])
def test_a_smaller_cloud_has_its_points_once(tmp_path, sampling):
    """The two samplings of 750 of 1,500 points have none in common, and no subset has a point twice."""
    data = replace(write_clouds(tmp_path, cloud(1500), cloud(2500)), points=750, sampling=sampling)
    shards = Shards(prepare(data, BOTH, tmp_path / "out", workers=1, progress=False), "train")
    assert shards.points(0).shape == (1500, 3)
    assert len(np.unique(shards.points(0), axis=0)) == 1500
    assert Shards(tmp_path / "out", "test").points(0).shape == (2048, 3)
    pair = Pairs(shards, np.array([0]), data, None, 0)[0]
    clouds = [pair["source"], (pair["target"] - pair["t"]) @ pair["R"]]
    nearest = [np.linalg.norm(c[:, None] - shards.points(0)[None], axis=-1).argmin(1) for c in clouds]
    assert [len(set(numbers)) for numbers in nearest] == [750, 750]
    common = len(set(nearest[0]) & set(nearest[1]))
    assert common == 0 if sampling == "twice" else 300 < common < 450


def test_too_small_a_cloud_is_refused(tmp_path):
    data = write_clouds(tmp_path, cloud(600), cloud(2500))
    prepare(data, BOTH, tmp_path / "out", workers=1, progress=False)
    with pytest.raises(ValueError, match=r"needs 1024 points of every object, but .* has objects of 600"):
        ensure_prepared(data, BOTH)
    check_settings(tmp_path / "out", replace(data, points=600), BOTH)
    with pytest.raises(ValueError, match=r"sampling = twice needs 602 points of every object, but .* has objects of 600"):
        check_settings(tmp_path / "out", replace(data, points=301, sampling="twice"), BOTH)


def test_ensure_prepared_prepares_once_in_a_folder_of_its_settings(data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few = replace(data, points=512)
    assert prepared_folder(data, VIEWS) == prepared_folder(few, VIEWS), "512 points are the first of 1,024"
    assert prepared_folder(data, BOTH) == prepared_folder(data, replace(BOTH, of="target")), "no views are stored"
    assert len({prepared_folder(data, views) for views in (VIEWS, BOTH, ViewsConfig())}) == 3
    made = []
    monkeypatch.setattr(preparation, "prepare", lambda *args: made.append(prepare(*args, workers=1, progress=False)))
    folder = ensure_prepared(data, VIEWS)
    assert folder.parent == Path("data")
    assert ensure_prepared(few, VIEWS) == folder
    assert ensure_prepared(replace(data, prepared=str(folder)), VIEWS) == folder
    assert len(made) == 1


def test_modelnet40_at_full_size_fits_in_13_gb():
    job = Job(Path(), "train-00000", {}, 2048, ViewsConfig(), tuple(range(12_311)), None)
    assert sum(job.file_bytes().values()) < 13e9


def test_a_script_that_its_workers_import_fails_with_an_explanation(meshes, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from cmig_jax.config import DataConfig, ViewsConfig\n"
        "from cmig_jax.data import prepare\n"
        "prepare.OBJECTS_PER_SHARD = 4\n"
        f"data = DataConfig(source='meshes', root={str(meshes)!r})\n"
        "prepare.prepare(data, ViewsConfig(of='both'), 'prepared', workers=2, progress=False)\n"
    )
    run = subprocess.run([sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 1
    assert "OSError: a process that prepared prepared has ended early" in run.stderr
    assert "if __name__ == '__main__':" in run.stderr


def test_so_does_one_from_the_standard_input_with_many_objects(tmp_path):
    script = (
        "from cmig_jax.config import DataConfig, ViewsConfig\n"
        "from cmig_jax.data.prepare import prepare\n"
        "prepare(DataConfig(source='shapes', shapes=100), ViewsConfig(of='both'), 'prepared', workers=2, progress=False)\n"
    )
    run = subprocess.run([sys.executable, "-"], input=script, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 1
    assert "OSError: a process that prepared prepared has ended early" in run.stderr


@pytest.mark.parametrize(
    ("objects", "workers", "message"),
    [
        ((), 1, r"data\.source = odd, data\.root = None: 0 objects; expected at least 1"),
        ([RawObject(f"o{i}", 0, "train", lambda: cloud(9)) for i in range(5)], 2, "o0: its `read` cannot be sent to worker processes"),
        ([RawObject("o", 0, "train", lambda: np.zeros((9, 2)))], 1, r"o: shape \(9, 2\)"),
    ],
)
def test_objects_that_cannot_be_prepared_are_an_error(tmp_path, monkeypatch, objects, workers, message):
    monkeypatch.setitem(SOURCES, "odd", Source("odd", lambda data: RawDataset(("a",), objects), folder=None))
    with pytest.raises(ValueError, match=message):
        prepare(DataConfig(source="odd"), BOTH, tmp_path / "out", workers=workers, progress=False)
    assert not list((tmp_path / "out").glob("*.npy"))
