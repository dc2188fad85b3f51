"""Readers give every object of a source, and name the file, the value and what was expected where they cannot."""

import json
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from cmig_jax.config import DataConfig
from cmig_jax.data.geometry_files import read_geometry
from cmig_jax.data.readers import open_raw
from cmig_jax.data.stanford import read_scans

_RNG = np.random.default_rng(0)


def _open(source, root=None, **flags):
    return open_raw(DataConfig(source=source, root=None if root is None else str(root), **flags))


def _count(dataset, split):
    return sum(item.split == split for item in dataset.objects)


@pytest.mark.parametrize("source", ["modelnet40-hdf5", "meshes", "stanford", "sevenscenes"])
def test_a_missing_or_empty_root_is_an_error(source, tmp_path):
    with pytest.raises(ValueError, match=r"data\.root = None: expected"):
        _open(source)
    with pytest.raises(ValueError, match=r"nowhere: no such folder; expected"):
        _open(source, tmp_path / "nowhere")
    with pytest.raises(ValueError, match=rf"{tmp_path}.*: no .*expected"):
        _open(source, tmp_path)


# Generated shapes


def test_shapes_are_a_function_of_split_label_and_index():
    few, many = _open("shapes", shapes=4), _open("shapes", shapes=9)
    assert (_count(few, "train"), _count(few, "test")) == (160, 40)
    assert (_count(many, "train"), _count(many, "test")) == (360, 80)
    by_name = {item.name: item for item in many.objects}
    assert len(by_name) == len(many.objects)
    for item in few.objects[::17]:
        np.testing.assert_array_equal(item.mesh.vertices, by_name[item.name].mesh.vertices)
    train, test = (next(i for i in few.objects if i.split == split) for split in ("train", "test"))
    assert not np.array_equal(train.mesh.bounds, test.mesh.bounds)
    assert train.points is None


def test_objects_travel_to_other_processes():
    item = _open("shapes", shapes=4).objects[7]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(item)).mesh.vertices, item.mesh.vertices)


# ModelNet40 HDF5


def _write_hdf5(folder: Path, name: str, count: int, *, labels=None, dtype=np.float32, **datasets) -> Path:
    data = np.clip(_RNG.normal(size=(count, 32, 3)) * 0.2, -0.5, 0.5).astype(dtype)
    datasets = {"data": data, "label": np.arange(count, dtype=np.uint8)[:, None] % 2 if labels is None else labels} | datasets
    with h5py.File(folder / name, "w") as file:
        for key, value in datasets.items():
            if value is not None:
                file[key] = value
    return folder / name


@pytest.fixture
def hdf5(tmp_path):
    (tmp_path / "shape_names.txt").write_text("cup\nchair\n")
    _write_hdf5(tmp_path, "ply_data_train0.h5", 5)
    _write_hdf5(tmp_path, "ply_data_train1.h5", 3, dtype=np.float16)
    _write_hdf5(tmp_path, "ply_data_test0.h5", 2)
    return tmp_path


def test_hdf5_gives_every_row_of_every_file(hdf5):
    (hdf5 / "ply_data_train_0_id2file.json").write_text(json.dumps([f"cup/cup_{i}.ply" for i in range(5)]))
    (hdf5 / "ply_data_test_0_id2name.txt").write_text("pack\ta.obj\npack\tb.obj\n")
    dataset = _open("modelnet40-hdf5", hdf5)
    assert dataset.categories == ("cup", "chair")
    assert (_count(dataset, "train"), _count(dataset, "test")) == (8, 2)
    assert [item.label for item in dataset.objects] == [0, 1, 0, 1, 0, 0, 1, 0, 0, 1]
    names = [item.name for item in dataset.objects]
    assert names[4:6] == ["cup/cup_4.ply", "ply_data_train1.h5[0]"]
    assert names[8:] == ["pack/a.obj", "pack/b.obj"]
    with h5py.File(hdf5 / "ply_data_train1.h5") as file:
        np.testing.assert_array_equal(dataset.objects[6].points, file["data"][1].astype(np.float32))
    assert dataset.objects[6].points.dtype == np.float64
    assert all(item.mesh is None and item.shuffled for item in dataset.objects)


@pytest.mark.parametrize(
    ("datasets", "message"),
    [
        ({"data": None}, r"holds \['label'\]; expected a dataset `data`"),
        ({"label": None}, r"holds \['data'\]; expected a dataset `label`"),
        ({"data": np.zeros((5, 96))}, r"data of shape \(5, 96\); expected \[n, points, 3\]"),
        ({"data": np.zeros((5, 32, 2))}, r"data of shape \(5, 32, 2\)"),
        ({"label": np.zeros((4, 1), int)}, r"label of shape \(4, 1\).*expected 5"),
        ({"label": np.zeros((5, 1), np.float32)}, "label of shape .*float32; expected 5 whole numbers"),
        ({"label": np.full((5, 1), 2)}, "label 2; expected 0 to 1"),
        ({"label": np.full((5, 1), -1)}, "label -1; expected 0 to 1"),
    ],
)
def test_a_wrong_hdf5_file_is_an_error(hdf5, datasets, message):
    _write_hdf5(hdf5, "ply_data_train0.h5", 5, **datasets)
    with pytest.raises(ValueError, match=rf"ply_data_train0\.h5: {message}"):
        _open("modelnet40-hdf5", hdf5)


def test_a_damaged_hdf5_folder_is_an_error(hdf5):
    bad = np.zeros((2, 32, 3), np.float32)
    bad[1, 4] = np.nan
    _write_hdf5(hdf5, "ply_data_test0.h5", 2, data=bad)
    with pytest.raises(ValueError, match=r"ply_data_test0\.h5\[1\]: point 4 is"):
        _open("modelnet40-hdf5", hdf5).objects[-1].geometry()
    (hdf5 / "ply_data_test_0_id2name.txt").write_text("one\n")
    with pytest.raises(ValueError, match=r"id2name\.txt: 1 names; expected 2"):
        _open("modelnet40-hdf5", hdf5)
    train = hdf5 / "ply_data_train0.h5"
    train.write_bytes(train.read_bytes()[:500])
    with pytest.raises(ValueError, match=r"ply_data_train0\.h5: not a readable HDF5 file"):
        _open("modelnet40-hdf5", hdf5)
    (hdf5 / "shape_names.txt").unlink()
    with pytest.raises(ValueError, match=r"shape_names\.txt: no such file"):
        _open("modelnet40-hdf5", hdf5)


def test_real_hdf5_objects(real_data):
    dataset = _open("modelnet40-hdf5", real_data("objects_hdf5_2048"))
    assert len(dataset.categories) == 40
    assert (_count(dataset, "train"), _count(dataset, "test")) == (2352, 587)
    assert {item.label for item in dataset.objects} == set(range(40))
    assert len({item.name for item in dataset.objects}) == 2939
    points = dataset.objects[100].points
    assert points.shape == (2048, 3)
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(1, abs=2e-3)


# Meshes and clouds


def _box(width: float = 1.0) -> trimesh.Trimesh:
    return trimesh.creation.box((width, 2, 3))


def _off(mesh: trimesh.Trimesh, header: str = "OFF\n") -> str:
    lines = [f"{header}{len(mesh.vertices)} {len(mesh.faces)} 0", *(f"{x} {y} {z}" for x, y, z in mesh.vertices)]
    return "\n".join([*lines, *(f"3 {a} {b} {c}" for a, b, c in mesh.faces)]) + "\n"


@pytest.mark.parametrize("header", ["OFF\n", "OFF", "# made by hand\nOFF\n", "OFF\r\n"])
def test_off_headers(tmp_path, header):
    (tmp_path / "a.off").write_text(_off(_box(), header))
    mesh = read_geometry(tmp_path / "a.off")
    assert mesh.area == pytest.approx(22)
    assert mesh.volume == pytest.approx(6)


@pytest.mark.parametrize("suffix", [".off", ".obj", ".ply", ".stl"])
def test_every_format_gives_the_same_surface(tmp_path, suffix):
    path = tmp_path / f"a{suffix.upper()}"
    _box().export(str(path), file_type=suffix[1:])
    mesh = read_geometry(path)
    assert mesh.area == pytest.approx(22, rel=1e-5)
    assert mesh.volume == pytest.approx(6, rel=1e-5)


def test_parts_of_an_obj_and_ascii_stl(tmp_path):
    first = "mtllib none.mtl\no one\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "a.obj").write_text(first + "o two\nusemtl blue\nv 5 0 0\nv 6 0 0\nv 6 1 0\nv 5 1 0\nf 4/1 5/1 6/1 7/1\n")
    assert read_geometry(tmp_path / "a.obj").area == pytest.approx(1.5)
    (tmp_path / "a.stl").write_text(_box().export(file_type="stl_ascii"))
    assert read_geometry(tmp_path / "a.stl").area == pytest.approx(22)


def test_clouds(tmp_path):
    points = _RNG.normal(size=(20, 3)).astype(np.float32)
    np.save(tmp_path / "a.npy", points.astype(np.float64))
    trimesh.PointCloud(points).export(tmp_path / "b.ply")
    for name in ("a.npy", "b.ply"):
        cloud = read_geometry(tmp_path / name)
        assert cloud.dtype == np.float64
        np.testing.assert_array_equal(cloud, points)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.off", b"", "not a readable OFF file"),
        ("words.off", b"hello there\n1 2 3\n", "expected a first line OFF"),
        ("short.off", _off(_box())[:-40].encode(), "expected 8 vertices and 12 faces"),
        ("cut.off", _off(_box()).rstrip()[:-3].encode(), "the last face has"),
        ("none.off", b"OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n", "0 faces"),
        ("flat.off", b"OFF\n3 1 0\n0 0 0\n0 0 0\n0 0 0\n3 0 1 2\n", "surface area 0"),
        ("nan.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 nan 0\n3 0 1 2\n", "point 2 is"),
        ("index.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n", "range of its vertices|vertex 9"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "0 faces"),
        ("empty.obj", b"", "0 faces"),
        ("junk.ply", b"ply\nformat ascii 1.0\n", "no end_header"),
        ("cut.ply", trimesh.creation.box().export(file_type="ply")[:-20], "not a readable PLY file"),
        ("text.ply", trimesh.creation.box().export(file_type="ply", encoding="ascii")[:-60], "lines of data; expected 20"),
        ("cut.stl", trimesh.creation.box().export(file_type="stl")[:200], "not a readable STL file"),
        ("junk.npy", b"\x93NUMPY", "not a readable NPY file"),
        ("mesh.gltf", b"{}", "expected a file of .off, .obj, .ply, .stl, .npy"),
    ],
)
def test_a_bad_file_is_an_error_that_names_it(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=message) as raised:
        read_geometry(tmp_path / name)
    assert str(raised.value).startswith(str(tmp_path / name))


@pytest.mark.parametrize("shape", [(0, 3), (5, 2), (5,)])
def test_an_array_of_another_shape_is_an_error(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    with pytest.raises(ValueError, match=r"a\.npy: points of shape .* expected \[P, 3\]"):
        read_geometry(tmp_path / "a.npy")


def test_mesh_folders_with_splits(tmp_path):
    for category in ("lamp", "bowl"):
        for split, count in (("train", 3), ("test", 2)):
            (tmp_path / category / split).mkdir(parents=True)
            for i in range(count):
                (tmp_path / category / split / f"{category}_{i}.off").write_text(_off(_box(i + 1), "OFF"))
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / "README.txt").write_text("not an object")
    (tmp_path / "bowl" / "train" / "._bowl_0.off").write_text("not an object either")
    dataset = _open("meshes", tmp_path)
    assert dataset.categories == ("bowl", "lamp")
    assert [(item.name, item.label, item.split) for item in dataset.objects[2:8]] == [
        ("bowl/train/bowl_2.off", 0, "train"),
        ("lamp/train/lamp_0.off", 1, "train"),
        ("lamp/train/lamp_1.off", 1, "train"),
        ("lamp/train/lamp_2.off", 1, "train"),
        ("bowl/test/bowl_0.off", 0, "test"),
        ("bowl/test/bowl_1.off", 0, "test"),
    ]
    assert dataset.objects[4].mesh.extents[0] == pytest.approx(2)
    (tmp_path / "lamp" / "test" / "lamp_0.off").unlink()
    (tmp_path / "lamp" / "test" / "lamp_1.off").unlink()
    with pytest.raises(ValueError, match=r"lamp/test: 0 objects"):
        _open("meshes", tmp_path)


@pytest.mark.parametrize(("count", "held"), [(2, 1), (5, 1), (10, 2), (13, 3)])
def test_mesh_folders_without_splits_hold_out_the_last(tmp_path, count, held):
    (tmp_path / "cup").mkdir()
    for i in range(count):
        np.save(tmp_path / "cup" / f"{i:02d}.npy", np.eye(3) * (i + 1))
    dataset = _open("meshes", tmp_path)
    assert [item.name for item in dataset.objects] == [f"cup/{i:02d}.npy" for i in range(count)]
    assert [item.split for item in dataset.objects] == ["train"] * (count - held) + ["test"] * held


@pytest.mark.parametrize("count", [0, 1])
def test_a_category_with_one_object_is_an_error(tmp_path, count):
    (tmp_path / "cup").mkdir()
    for i in range(count):
        (tmp_path / "cup" / f"{i}.off").write_text(_off(_box()))
    with pytest.raises(ValueError, match=rf"cup: a category with {count} object\(s\); expected at least 2"):
        _open("meshes", tmp_path)


# Stanford

_QUATERNION = np.array([0.1, -0.3, 0.2, 0.9]) / np.linalg.norm([0.1, -0.3, 0.2, 0.9])


def _rotation(x: float, y: float, z: float, w: float) -> np.ndarray:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _write_scans(folder: Path) -> np.ndarray:
    folder.mkdir(parents=True)
    world = _RNG.uniform(-1, 1, (200, 3))
    shift = np.array([0.1, 0.2, -0.3])
    trimesh.PointCloud(world).export(folder / "a.ply")
    trimesh.PointCloud((world - shift) @ _rotation(*_QUATERNION).T).export(folder / "b.ply")
    numbers = " ".join(str(v) for v in (*shift, *_QUATERNION))
    (folder / "toy.conf").write_text(f"camera 0 0 0 0 0 0 1\nbmesh a.ply 0 0 0 0 0 0 1\nbmesh b.ply {numbers}\n\n")
    return world


def test_scans_meet_in_the_world(tmp_path):
    world = _write_scans(tmp_path / "toy")
    one, two = read_scans(tmp_path / "toy" / "toy.conf")
    assert (one.name, two.name) == ("a", "b")
    np.testing.assert_array_equal(one.world_from_scan, np.eye(4))
    np.testing.assert_allclose(two.points @ two.world_from_scan[:3, :3].T + two.world_from_scan[:3, 3], world, atol=1e-5)


def test_stanford_objects(tmp_path):
    world = _write_scans(tmp_path / "toy")
    (tmp_path / "models").mkdir()
    _box().export(tmp_path / "models" / "box.ply")
    dataset = _open("stanford", tmp_path)
    assert dataset.categories == ("scan",)
    assert [(item.name, item.split) for item in dataset.objects] == [("toy", "test"), ("models/box.ply", "test")]
    assert cKDTree(dataset.objects[0].points).query(world)[0].max() < 0.01
    assert dataset.objects[1].mesh.area == pytest.approx(22, rel=1e-5)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("bmesh a.ply 0 0 0 0 0 1", r"line 1: .*expected bmesh FILE tx ty tz qx qy qz qw"),
        ("bmesh a.ply 0 0 0 0 0 zero 1", "line 1: .*zero"),
        ("bmesh a.ply 0 0 0 0 0 0 0", r"line 1: .*expected bmesh"),
        ("bmesh c.ply 0 0 0 0 0 0 1", r"c\.ply: no such file"),
        ("camera 0 0 0 0 0 0 1", "no scans"),
    ],
)
def test_a_bad_conf_is_an_error(tmp_path, line, message):
    _write_scans(tmp_path / "toy")
    (tmp_path / "toy" / "toy.conf").write_text(line + "\n")
    with pytest.raises(ValueError, match=message):
        read_scans(tmp_path / "toy" / "toy.conf")
    with pytest.raises(ValueError, match=r"none\.conf: no such file"):
        read_scans(tmp_path / "none.conf")


_FEW = (["bun000.ply"], ["bun045.ply"], ["bun315.ply"])


def test_real_scans_of_the_bunny_fit(tmp_path, real_data):
    folder = real_data("stanford_bunny_scans")
    lines = [line.split() for line in (folder / "bun.conf").read_text().splitlines()]
    few = [f"bmesh {folder / words[1]} {' '.join(words[2:])}" for words in lines if words[1:2] in _FEW]
    (tmp_path / "few.conf").write_text("\n".join(few))
    scans = {scan.name: scan for scan in read_scans(tmp_path / "few.conf")}
    world = {name: s.points @ s.world_from_scan[:3, :3].T + s.world_from_scan[:3, 3] for name, s in scans.items()}
    for one, two in (("bun000", "bun045"), ("bun315", "bun000")):
        assert np.median(cKDTree(world[two]).query(world[one])[0]) < 0.46e-3


# 7-Scenes

_INTRINSICS = np.array([[20.0, 0, 16], [0, 20, 12], [0, 0, 1]])


def _pose(i: int) -> np.ndarray:
    angle = 0.004 * i
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    pose[:3, 3] = (0.02 * i, 0.01 * i, 0.5)
    return pose


def _write_frames(folder: Path, count: int) -> None:
    """Frames that look at the plane z = 3 m of the world."""
    folder.mkdir(parents=True)
    v, u = np.mgrid[:24, :32]
    rays = np.stack([(u - 16) / 20, (v - 12) / 20, np.ones(u.shape)], -1)
    for i in range(count):
        pose = _pose(i)
        depth = np.round((3 - pose[2, 3]) / (rays @ pose[2, :3]) * 1000).astype(np.uint16)
        depth[0, :] = 65535
        depth[:, 0] = 0
        Image.fromarray(depth).save(folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)


def test_fragments_lie_in_the_frame_of_their_first_camera(tmp_path):
    _write_frames(tmp_path / "plane", 130)
    np.savetxt(tmp_path / "camera-intrinsics.txt", _INTRINSICS)
    dataset = _open("sevenscenes", tmp_path / "plane")
    assert [item.name for item in dataset.objects] == [f"plane/fragment-{i:03d}" for i in range(3)]
    assert {item.split for item in dataset.objects} == {"test"}
    for item, first in zip(dataset.objects, (0, 50, 100), strict=True):
        pose = _pose(first)
        world = item.points @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(world[:, 2], 3, atol=0.003)
        spacing = cKDTree(item.points).query(item.points, k=2)[0][:, 1]
        assert np.median(spacing) < 0.05
        assert len(item.points) < 50 * 23 * 31


def test_scenes_are_categories_and_the_office_is_held_out(tmp_path):
    for scene, count in (("chess", 3), ("office", 4), ("stairs", 60)):
        _write_frames(tmp_path / scene / "seq-01", count)
    np.savetxt(tmp_path / "camera-intrinsics.txt", _INTRINSICS)
    (tmp_path / "red").mkdir()
    trimesh.PointCloud(_RNG.normal(size=(9, 3))).export(tmp_path / "red" / "cloud_bin_0.ply")
    dataset = _open("sevenscenes", tmp_path)
    assert dataset.categories == ("chess", "office", "red", "stairs")
    assert [(item.name, item.split, item.label) for item in dataset.objects] == [
        ("chess/seq-01/fragment-000", "train", 0),
        ("red/cloud_bin_0.ply", "train", 2),
        ("stairs/seq-01/fragment-000", "train", 3),
        ("office/seq-01/fragment-000", "test", 1),
    ]
    assert dataset.objects[1].points.shape == (9, 3)


def _spoil_png(folder: Path) -> None:
    path = folder / "frame-000001.depth.png"
    path.write_bytes(path.read_bytes()[:60])


def _eight_bits(folder: Path) -> None:
    Image.fromarray(np.zeros((24, 32), np.uint8)).save(folder / "frame-000001.depth.png")


def _no_depth(folder: Path) -> None:
    for path in folder.glob("*.png"):
        Image.fromarray(np.full((24, 32), 65535, np.uint16)).save(path)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: (folder / "frame-000001.pose.txt").unlink(), r"frame-000001\.pose\.txt: no such file"),
        (lambda folder: (folder / "frame-000001.pose.txt").write_text("1 2\n3 4\n"), r"pose\.txt: .*expected an invertible \[4, 4\]"),
        (lambda folder: np.savetxt(folder / "frame-000001.pose.txt", np.eye(4) * np.nan), r"pose\.txt: .*finite"),
        (lambda folder: (folder / "frame-000001.pose.txt").write_text("lost\n"), r"pose\.txt: not a readable matrix"),
        (_spoil_png, r"frame-000001\.depth\.png: not a readable PNG"),
        (_eight_bits, r"depth\.png: pixels of shape \(24, 32\), uint8"),
        (_no_depth, "no depth in 3 frames"),
        (lambda folder: (folder / "camera-intrinsics.txt").write_text("585 585 320 240\n"), r"intrinsics\.txt: .*expected an invertible"),
    ],
)
def test_a_bad_frame_is_an_error(tmp_path, spoil, message):
    _write_frames(tmp_path / "plane", 3)
    spoil(tmp_path / "plane")
    with pytest.raises(ValueError, match=message):
        _open("sevenscenes", tmp_path / "plane").objects[0].geometry()


def test_real_fragments_of_the_kitchen_meet(tmp_path, real_data):
    # Every tenth frame keeps the test short; the links keep fragment 0 to frames 0-49 and put fragment 1 in frame 50.
    folder = real_data("sevenscenes_redkitchen")
    for part, frames in (("a", range(0, 50, 10)), ("b", range(50, 100, 10))):
        (tmp_path / part).mkdir()
        for number in frames:
            for kind in ("depth.png", "pose.txt"):
                (tmp_path / part / f"frame-{number:06d}.{kind}").symlink_to(folder / f"frame-{number:06d}.{kind}")
    zero, one = (_open("sevenscenes", tmp_path / part).objects[0].points for part in ("a", "b"))
    zero_from_one = np.array(
        [
            [0.996926560, 0.0668735757, -0.0406664421, -0.115576939],
            [-0.0661289946, 0.997617877, 0.0194008687, -0.0387705398],
            [0.0418675510, -0.0166517807, 0.998977765, 0.114874890],
        ]
    )
    tree = cKDTree(zero)
    aligned = tree.query((one @ zero_from_one[:, :3].T + zero_from_one[:, 3])[::20])[0]
    assert np.median(aligned) < 0.015
    assert np.median(tree.query(one[::20])[0]) > 3 * np.median(aligned)
