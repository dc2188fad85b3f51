"""Pairs of recordings: the true transform, what each pair is a function of, and its views."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.normals import estimate_normals
from cmig_jax.data.pairs import render_clouds
from cmig_jax.data.recorded_pairs import RecordedPairs
from cmig_jax.data.recordings import ensure_recordings

VIEWS = ViewsConfig(of="both", count=6, size=16, layout="axes")


@pytest.fixture
def data(tmp_path, scans) -> DataConfig:
    """Scans, and flags that keep every pair of them and every point."""
    root = scans.write(tmp_path / "scans")
    return DataConfig(source="stanford-scans", root=str(root), prepared=str(tmp_path / "out"), points=1200, crop="none", max_angle_deg=180)


def pairs_of(data: DataConfig, views: ViewsConfig | None = VIEWS, limit: int | None = None) -> RecordedPairs:
    return RecordedPairs(ensure_recordings(data, progress=False), data, views, limit)


def assert_same(one, other, names):
    for name in names:
        np.testing.assert_array_equal(one[name], other[name])


def test_the_true_transform_brings_the_shared_points_together(data):
    pairs = pairs_of(data)
    assert pairs.names == tuple(f"toy/toy{i} to toy/toy{j}" for i, j in ((0, 1), (1, 0), (1, 2), (2, 1)))
    assert pairs.categories == ("toy",)
    assert [int(pair["index"]) for pair in pairs] == [0, 1, 2, 3]
    for pair in pairs:
        moved = pair["source"] @ pair["R"].T + pair["t"]
        nearest = KDTree(pair["target"]).query(moved)[0]
        assert np.mean(nearest < 1e-5) == pytest.approx(float(pair["overlap"]), abs=0.1)
        assert KDTree(pair["target"]).query(pair["source"])[0].min() > 1e-5
        assert {value.dtype for name, value in pair.items() if name in ("source", "target", "R", "t")} == {np.dtype(np.float32)}
        assert "object" not in pair


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_clouds_are_centred_each_and_scaled_together(tmp_path, data, scans, unit):
    data = replace(data, root=str(scans.write(tmp_path / "other", unit=unit)), prepared=str(tmp_path / "other-out"))
    pair = pairs_of(data, None)[0]
    x, y = (unit * (scans.world[scans.parts[k]] - scans.shifts[k]) @ scans.poses[k].as_matrix().T for k in (0, 1))
    scale = max(np.linalg.norm(cloud - cloud.mean(0), axis=1).max() for cloud in (x, y))
    for cloud, found in ((x, pair["source"]), (y, pair["target"])):
        expected = (cloud - cloud.mean(0)) / scale
        np.testing.assert_allclose(found[np.lexsort(found.T)], expected[np.lexsort(expected.astype(np.float32).T)], atol=1e-5)
    t = y.mean(0) + scale * pair["t"] - pair["R"] @ x.mean(0)  # back in the unit of the scans
    R = scans.poses[1].as_matrix() @ scans.poses[0].as_matrix().T
    np.testing.assert_allclose(pair["R"], R, atol=1e-5)
    np.testing.assert_allclose(t, unit * scans.poses[1].as_matrix() @ (scans.shifts[0] - scans.shifts[1]), atol=1e-4 * unit)


def test_a_pair_has_as_many_points_as_a_cropped_one(data):
    pairs = pairs_of(replace(data, points=400, crop="shared", keep=0.75))
    assert pairs[0]["source"].shape == pairs[0]["target"].shape == (300, 3)
    for position in (4, -5):
        with pytest.raises(IndexError):
            pairs[position]
    with pytest.raises(ValueError, match=r"toy/toy0 has 1200 points: expected at least 1201, from data\.points and data\.keep"):
        pairs_of(replace(data, points=1201))[0]


def test_a_crop_of_the_source_alone_leaves_the_target_its_number_of_points(data):
    pair = pairs_of(replace(data, points=400, crop="source", keep=0.75), None)[0]
    assert (pair["source"].shape, pair["target"].shape) == ((300, 3), (400, 3))


@pytest.mark.parametrize("kind", ["object", "observed"])
def test_normals_are_those_of_the_whole_recordings_and_change_nothing_else(data, kind):
    few = replace(data, points=400, normals=kind)
    every, without = pairs_of(data, None)[1], pairs_of(few, None)[1]
    pair = RecordedPairs(ensure_recordings(few, progress=False), few, None, normals=True)[1]
    assert set(pair) - set(without) == {"source_normals", "target_normals"}
    assert_same(pair, without, without)
    for cloud in ("source", "target"):
        assert pair[f"{cloud}_normals"].dtype == np.float32
        np.testing.assert_allclose(pair[f"{cloud}_normals"], estimate_normals(every[cloud], at=pair[cloud]), atol=1e-3)


@pytest.mark.parametrize("shown", ["real", "shuffled"])
def test_a_pair_is_a_function_of_seed_and_name(data, shown):
    """A limit or a smaller angle leaves out pairs and changes no other."""
    data, views = replace(data, points=400), replace(VIEWS, shown=shown)
    pairs, few, near = pairs_of(data, views), pairs_of(data, views, limit=2), pairs_of(replace(data, max_angle_deg=45.0), views)
    assert few.names == (pairs.names[0], pairs.names[3])
    assert near.names == pairs.names[:2]
    for one, other in ((few[1], pairs[3]), (few[-1], pairs[-1]), (near[1], pairs[1])):
        assert_same(one, other, other)
    assert not np.array_equal(pairs_of(replace(data, test_seed=5))[3]["source"], pairs[3]["source"])
    with pytest.raises(ValueError, match=r"data\.max_angle_deg = 20.0: the rotations of the 4 pairs of .* expected at least 30\.\d"):
        pairs_of(replace(data, max_angle_deg=20.0))


def test_a_pair_does_not_depend_on_the_other_recordings_of_the_source(tmp_path, data, scans):
    data = replace(data, points=400)
    pairs = pairs_of(data)
    scans.write(tmp_path / "scans" / "more", "cat")  # before "toy" by name
    more = pairs_of(replace(data, prepared=str(tmp_path / "more-out")))
    assert more.names[4:] == pairs.names
    for position, pair in enumerate(pairs):
        assert_same(more[4 + position], pair, set(pair) - {"label", "index"})


def test_views_show_the_observed_clouds_or_those_of_another_pair_or_nothing(data):
    pair, shuffled, zero = (pairs_of(data, replace(VIEWS, shown=shown))[1] for shown in ("real", "shuffled", "zero"))
    np.testing.assert_array_equal(pair["views"], render_clouds(pair, VIEWS))
    for other in (shuffled, zero, pairs_of(data, None)[1] | {"views": None}):
        assert_same(other, pair, set(pair) - {"views"})
        assert not np.array_equal(other["views"], pair["views"])
        assert not np.array_equal(other["views"], pair["views"][::-1])  # nor those of the same two clouds, exchanged
    assert (zero["views"].shape, zero["views"].any()) == ((2, 6, 16, 16), False)
    with pytest.raises(ValueError, match=r"views\.of = object with data\.source = stanford-scans: .* expected views\.of = source"):
        pairs_of(data, replace(VIEWS, of="object"))


def test_consecutive_fragments_of_the_held_out_scene_are_pairs(tmp_path, frames):
    for place, count in (("scenes/office/seq-01", 150), ("scenes/office/seq-02", 100), ("scenes/chess/seq-01", 5)):
        frames.write(tmp_path / place, count)
    np.savetxt(tmp_path / "scenes" / "camera-intrinsics.txt", frames.intrinsics)
    root, out = str(tmp_path / "scenes"), str(tmp_path / "out")
    pairs = pairs_of(DataConfig(source="sevenscenes-fragments", root=root, prepared=out, points=400, crop="none"), None)
    assert pairs.categories == ("chess", "office")
    assert {int(pair["label"]) for pair in pairs} == {1}
    one, two = "office/seq-01/fragment-", "office/seq-02/fragment-"
    expected = [(one, 0, 1), (one, 1, 0), (one, 1, 2), (one, 2, 1), (two, 0, 1), (two, 1, 0)]
    assert pairs.names == tuple(f"{name}{i:03d} to {name}{j:03d}" for name, i, j in expected)
    for (_, i, j), pair in zip(expected, pairs, strict=True):
        np.testing.assert_allclose(pair["R"], (np.linalg.inv(frames.camera(50 * j)) @ frames.camera(50 * i))[:3, :3], atol=1e-6)
        moved = pair["source"] @ pair["R"].T + pair["t"]
        assert np.median(KDTree(pair["target"]).query(moved)[0]) < 0.6 * np.median(KDTree(pair["target"]).query(pair["source"])[0])


def test_two_real_scans_of_the_bunny_make_two_pairs(tmp_path, real_data):
    folder = real_data("stanford_bunny_scans")
    lines = [line.split() for line in (folder / "bun.conf").read_text().splitlines()]
    few = [f"bmesh {folder / words[1]} {' '.join(words[2:])}" for words in lines if words and words[1][:6] in ("bun000", "bun045")]
    (tmp_path / "bunny.conf").write_text("\n".join(few))
    out = str(tmp_path / "out")
    pairs = pairs_of(DataConfig(source="stanford-scans", root=str(tmp_path), prepared=out, points=20000, crop="none"), None)
    assert pairs.names == ("bunny/bun000 to bunny/bun045", "bunny/bun045 to bunny/bun000")
    assert float(pairs[0]["overlap"]) > 0.85
    assert np.degrees(Rotation.from_matrix(pairs[0]["R"]).magnitude()) == pytest.approx(34.3, abs=0.1)
    moved = pairs[0]["source"] @ pairs[0]["R"].T + pairs[0]["t"]
    assert np.median(KDTree(pairs[0]["target"]).query(moved)[0]) < 0.01
