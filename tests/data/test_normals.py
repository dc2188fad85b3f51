"""Normals: estimated, read, prepared, carried by pairs, and given to a network."""

import itertools
import json
import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import flax.linen as nn
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from jax import Array
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cmig_jax.config import ComputeConfig, Config, DataConfig, ModelFlags, Needs, OptimConfig, ViewsConfig
from cmig_jax.data.loader import stack, training_batches
from cmig_jax.data.normals import completed_normals, estimate_normals, observed_normals
from cmig_jax.data.pairs import Pairs
from cmig_jax.data.prepare import prepare
from cmig_jax.data.sample import sample_surface, sample_surface_and_normals
from cmig_jax.data.shards import MANIFEST, Shards, check_settings
from cmig_jax.devices import device_mesh, to_device
from cmig_jax.geometry.rotations import rotation_from_quaternion
from cmig_jax.inference.predictor import Predictor
from cmig_jax.models.base import Model
from cmig_jax.models.networks import NETWORKS
from cmig_jax.structs import Batch, Prediction
from cmig_jax.training.optim import optimizer
from cmig_jax.training.state import build, create_state, make_step
from cmig_jax.transform import RigidTransform

RNG = np.random.default_rng(0)
SPHERE = RNG.normal(size=(300, 3))
SPHERE /= np.linalg.norm(SPHERE, axis=1, keepdims=True)
TURN = Rotation.from_rotvec([0.4, -1.2, 2.0]).as_matrix()


def angles_deg(one, other):
    return np.degrees(np.arccos(np.clip(np.sum(one * other, axis=1), -1, 1)))


# --- estimated


def test_normals_of_a_sphere_and_of_a_box_point_outwards():
    cloud = 5 + 0.2 * SPHERE
    assert angles_deg(estimate_normals(cloud, 8), SPHERE).max() < 20
    points, true = sample_surface_and_normals(trimesh.creation.box((1, 2, 3)), 3000, np.random.default_rng(0))
    found = estimate_normals(points)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    assert np.median(angles_deg(found, true)) < 1e-3
    assert np.mean(angles_deg(found, true) < 60) > 0.99


def test_normals_turn_with_the_cloud_and_follow_the_order_of_its_points():
    cloud, order = SPHERE * [1, 0.7, 0.4], RNG.permutation(300)
    found = estimate_normals(cloud)
    np.testing.assert_allclose(estimate_normals(cloud @ TURN.T * 3 + [1, 2, 3]), found @ TURN.T, atol=1e-9)
    np.testing.assert_allclose(estimate_normals(cloud[order]), found[order], atol=1e-9)
    np.testing.assert_allclose(estimate_normals(cloud, at=cloud[order[:7]]), found[order[:7]], atol=1e-12)


@pytest.mark.parametrize("cloud", [np.ones((1, 3)), np.ones((40, 3)), np.linspace(0, 1, 9)[:, None] * [1, 2, 3], SPHERE[:2], SPHERE[:3]])
def test_normals_of_degenerate_clouds_are_unit_vectors(cloud):
    found = estimate_normals(cloud)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
    line = cloud[-1] - cloud[0]
    np.testing.assert_allclose(found @ line, 0, atol=1e-6)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="k = 2: expected at least 3 neighbours"):
        estimate_normals(SPHERE, 2)
    with pytest.raises(ValueError, match="points: 0 points; expected at least 1"):
        estimate_normals(np.zeros((0, 3)))


def test_a_large_cloud_is_thinned_first():
    """A sensor's noise is larger than the distance of the nearest of 200,000 points."""
    rng = np.random.default_rng(0)
    true = rng.normal(size=(200_000, 3))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    cloud = true + rng.normal(0, 0.003, true.shape)
    found = observed_normals(cloud, at=cloud[:500])
    assert found.dtype == np.float32
    assert angles_deg(found, true[:500]).mean() < 0.5 * angles_deg(estimate_normals(cloud, at=cloud[:500]), true[:500]).mean()


def test_normals_of_a_file_get_length_one_and_missing_ones_are_estimated():
    given = 7 * SPHERE
    given[3], given[5], given[8] = 0, np.nan, np.inf
    found = completed_normals(SPHERE, given)
    assert found.dtype == np.float32
    estimated, rest = [3, 5, 8], np.delete(np.arange(300), [3, 5, 8])
    np.testing.assert_allclose(found[rest], SPHERE[rest], atol=1e-6)
    np.testing.assert_allclose(found[estimated], observed_normals(SPHERE, SPHERE[estimated]), atol=1e-6)


# --- of a mesh


def test_points_of_a_mesh_have_the_normals_of_their_faces_and_are_the_same_without_them():
    mesh = trimesh.creation.icosphere(1)
    points, normals = sample_surface_and_normals(mesh, 400, np.random.default_rng(4))
    np.testing.assert_array_equal(points, sample_surface(mesh, 400, np.random.default_rng(4)))
    assert normals.dtype == np.float32
    height = points @ mesh.face_normals.T - np.sum(mesh.face_normals * mesh.triangles[:, 0], axis=1)
    np.testing.assert_allclose(height.max(axis=1), 0, atol=1e-6)
    np.testing.assert_allclose(normals, mesh.face_normals[height.argmax(axis=1)], atol=1e-5)


# --- of pairs


@dataclass
class Objects:
    """Clouds of 300 points with random unit vectors as normals, so that each tells its point."""

    labels = np.zeros(8, np.int32)
    names = tuple(f"thing {i}" for i in range(8))
    categories = ("thing",)

    def points(self, i):
        cloud = np.random.default_rng(i).normal(size=(300, 3))
        return (cloud / np.linalg.norm(cloud, axis=1).max()).astype(np.float32)

    def normals(self, i):
        vectors = np.random.default_rng(100 + i).normal(size=(300, 3))
        return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)

    def check_normals(self):
        pass

    def views(self, i):
        return np.zeros((6, 16, 16), np.uint8)


PROTOCOLS = [
    {"sampling": sampling, "crop": crop, "pose": pose, "noise_std": noise}
    for sampling, crop, pose, noise in itertools.product(
        ("once", "twice", "subsets"), ("shared", "independent", "half-space", "source", "none"), ("euler", "twist"), (0.0, 0.002)
    )
]


IDS = ["-".join(map(str, flags.values())) for flags in PROTOCOLS]


def pair_of(with_normals=True, **flags):
    return Pairs(Objects(), np.arange(8), DataConfig(points=100, **flags), None, 0, normals=with_normals)[3]


@pytest.mark.parametrize("flags", PROTOCOLS, ids=IDS)
def test_normals_of_the_object_follow_sampling_pose_order_and_crop(flags):
    pair, points, normals = pair_of(**flags), Objects().points(3), Objects().normals(3)
    for cloud, R, t in (("source", np.eye(3), np.zeros(3)), ("target", pair["R"], pair["t"])):
        found = pair[f"{cloud}_normals"]
        assert (found.dtype, found.shape) == (np.float32, pair[cloud].shape)
        at = np.argmax(found @ R @ normals.T, axis=1)
        assert len(set(at)) == len(at)
        np.testing.assert_allclose(found, normals[at] @ R.T, atol=1e-6)
        np.testing.assert_allclose(pair[cloud], points[at] @ R.T + t, atol=1e-6 + (0.05 if flags["noise_std"] else 0))


@pytest.mark.parametrize("flags", PROTOCOLS, ids=IDS)
@pytest.mark.parametrize("kind", ["object", "observed"])
def test_normals_change_nothing_else_of_a_pair(flags, kind):
    without, having = pair_of(False, **flags), pair_of(normals=kind, **flags)
    assert set(having) - set(without) == {"source_normals", "target_normals"}
    for name, value in without.items():
        np.testing.assert_array_equal(having[name], value)


def test_observed_normals_are_those_of_each_cloud_as_it_is_given():
    pair = pair_of(normals="observed", noise_std=0.02)
    for cloud in ("source", "target"):
        np.testing.assert_array_equal(pair[f"{cloud}_normals"], observed_normals(pair[cloud]))


# --- prepared

VIEWS = ViewsConfig(of="both", layout="axes", count=6, size=16)


@pytest.fixture
def data(meshes) -> DataConfig:
    return DataConfig(source="meshes", root=str(meshes), points=200, noise_std=0.0)


def prepared(data: DataConfig, folder: Path) -> Path:
    return prepare(data, VIEWS, folder, workers=1, progress=False)


def test_prepared_meshes_have_the_normals_of_their_faces(data, tmp_path):
    shards = Shards(prepared(data, tmp_path), "train", verify="checksum")
    for i in range(3):
        points, normals = shards.points(i), shards.normals(i)
        assert (normals.shape, normals.dtype) == (points.shape, np.float32)
        np.testing.assert_array_equal(np.sort(np.abs(normals), axis=1), np.tile([0, 0, 1], (len(points), 1)))  # boxes
        assert np.all(np.sum(points * normals, axis=1) > 0)
        for axis in range(3):
            side = points[np.abs(normals[:, axis]) == 1, axis]
            np.testing.assert_allclose(np.abs(side), np.abs(side[0]), atol=0.03)  # sides at either end of the axis, but for the centring


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.ply", "a.pcd", "a.xyz", "none"])
def test_clouds_keep_the_normals_of_their_file_and_others_are_estimated(tmp_path, name):
    rng = np.random.default_rng(3)
    points, normals = rng.normal(size=(1500, 3)) * 20 + 5, rng.normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    (tmp_path / "raw" / "thing").mkdir(parents=True)
    for i in range(2):
        write_cloud(tmp_path / "raw" / "thing" / f"{i}{name}", points, normals)
    shards = Shards(prepared(DataConfig(source="meshes", root=str(tmp_path / "raw")), tmp_path / "out"), "train")
    unit = (points - points.mean(0)) / np.linalg.norm(points - points.mean(0), axis=1).max()
    distance, at = KDTree(unit).query(shards.points(0))
    assert distance.max() < 1e-6
    expected = estimate_normals(unit)[at] if name == "none" else normals[at]
    np.testing.assert_allclose(shards.normals(0), expected, atol=1e-4)


def write_cloud(path: Path, points: np.ndarray, normals: np.ndarray) -> None:
    names = ("x", "y", "z", "nx", "ny", "nz")
    table = np.concatenate([points, normals], axis=1)
    rows = np.array([tuple(row) for row in table.astype(np.float32)], [(name, "f4") for name in names])
    if path.suffix == ".npz":
        np.savez(path, points=points, normals=normals)
    elif path.suffix == ".ply":
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *(f"property float {name}" for name in names)]
        path.write_bytes("\n".join([*header, "end_header", ""]).encode() + rows.tobytes())
    elif path.suffix == ".pcd":
        fields = f"FIELDS x y z normal_x normal_y normal_z\nSIZE {'4 ' * 6}\nTYPE {'F ' * 6}\nWIDTH {len(rows)}\nHEIGHT 1\nDATA binary\n"
        path.write_bytes(fields.encode() + rows.tobytes())
    elif path.suffix == ".xyz":
        np.savetxt(path, table)
    else:
        np.save(path.with_suffix(".npy"), table if path.suffix else points)


def test_normals_of_modelnet40_are_read_where_the_files_have_them(tmp_path):
    rng = np.random.default_rng(0)
    clouds, normals = rng.normal(size=(2, 2, 100, 3)).astype(np.float32)
    (tmp_path / "shape_names.txt").write_text("ball\nbox\n")
    for split in ("train", "test"):
        with h5py.File(tmp_path / f"ply_data_{split}0.h5", "w") as file:
            file["data"], file["label"] = clouds, np.array([[1], [0]], np.uint8)
            if split == "train":
                file["normal"] = normals
    folder = prepared(DataConfig(root=str(tmp_path)), tmp_path / "out")
    train, test = Shards(folder, "train"), Shards(folder, "test")
    for i in range(2):
        np.testing.assert_allclose(train.normals(i), normals[i] / np.linalg.norm(normals[i], axis=1, keepdims=True), atol=1e-6)
        np.testing.assert_array_equal(test.points(i), train.points(i))
        np.testing.assert_allclose(test.normals(i), estimate_normals(test.points(i)), atol=1e-6)
    with h5py.File(tmp_path / "ply_data_test0.h5", "a") as file:
        file["normal"] = normals[:, :50]
    with pytest.raises(ValueError, match=r"ply_data_test0\.h5\[0\]: normals of shape \(50, 3\); expected \(100, 3\), as the points"):
        prepared(DataConfig(root=str(tmp_path)), tmp_path / "other")


def test_a_folder_of_an_earlier_version_serves_networks_without_normals_and_says_what_adds_them(data, tmp_path, main, contents):
    folder = prepared(data, tmp_path / "out")
    complete = contents(folder)
    manifest = json.loads((folder / MANIFEST).read_text())
    for shard in itertools.chain(*manifest["splits"].values()):
        (folder / shard["files"].pop("normals")["name"]).unlink()
    (folder / MANIFEST).write_text(json.dumps(manifest))
    check_settings(folder, data, VIEWS)
    old = Shards(folder, "train", verify="checksum")
    without = Pairs(old, np.arange(6), data, None, 0)[1]
    observed = Pairs(old, np.arange(6), replace(data, normals="observed"), None, 0, normals=True)[1]
    assert set(observed) - set(without) == {"source_normals", "target_normals"}
    for make in (lambda: Pairs(old, np.arange(6), data, None, 0, normals=True), lambda: old.normals(0)):
        with pytest.raises(ValueError, match="was prepared by an earlier version, without normals; add them with: cmig prepare ") as caught:
            make()
    command = shlex.split(str(caught.value).split("add them with: ")[1])[1:]
    assert main(*command, "--workers", 1).returncode == 0
    assert contents(folder) == complete
    pair = Pairs(Shards(folder, "train"), np.arange(6), data, None, 0, normals=True)[1]
    for name in without:
        np.testing.assert_array_equal(pair[name], without[name])


# --- given to a network


@dataclass(frozen=True)
class ToyFlags(ModelFlags):
    """A pose from the largest features of points and normals."""

    network: ClassVar[str] = "toy-with-normals"
    title: ClassVar[str] = "Toy"

    @property
    def needs(self) -> Needs:
        return Needs(points=4, training_points=4, normals=True)


class ToyNetwork(nn.Module):
    """A layer for every point, a maximum over the points, and a layer for the pose."""

    flags: ToyFlags
    compute: ComputeConfig

    @nn.compact
    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> Prediction:
        assert batch.source_normals is not None
        assert batch.target_normals is not None
        rows = [jnp.concatenate(x, -1) for x in ((batch.source, batch.source_normals), (batch.target, batch.target_normals))]
        encode = nn.Dense(16)
        pose = nn.Dense(7)(jnp.concatenate([jnp.max(nn.relu(encode(x)), axis=1) for x in rows], -1))
        quaternion = jnp.concatenate([1 + pose[:, :1], pose[:, 1:4]], axis=-1)
        return Prediction(RigidTransform(R=rotation_from_quaternion(quaternion), t=pose[:, 4:]))


def toy_losses(prediction: Prediction, batch: Batch, flags: ToyFlags, compute: ComputeConfig) -> dict[str, Array]:
    assert batch.target_from_source is not None
    offset = prediction.target_from_source.apply(batch.source) - batch.target_from_source.apply(batch.source)
    return {"distance": jnp.mean(jnp.sum(offset**2, axis=-1))}


TOY = Model(flags=ToyFlags, build=ToyNetwork, losses=toy_losses)


@pytest.fixture
def toy(monkeypatch, data) -> Config:
    monkeypatch.setitem(NETWORKS, TOY.name, TOY)
    data = replace(data, pose="twist", crop="source", points=40, validation=0.4)
    return Config(name="toy", model=ToyFlags(), data=data, views=VIEWS, optim=OptimConfig(batch=2, epochs=1, learning_rate=1e-2))


@pytest.mark.parametrize("normals", ["object", "observed"])
def test_a_network_that_reads_normals_trains_on_clouds_of_two_sizes(toy, tmp_path, normals):
    config = replace(toy, data=replace(toy.data, normals=normals))
    pairs = Pairs(Shards(prepared(config.data, tmp_path / "out"), "train"), np.arange(6), config.data, None, 0, normals=True)
    batches, mesh = training_batches(pairs, config), device_mesh(2, 2)
    module, rule = build(config), optimizer(config.optim, 3)
    state, step = create_state(module, rule, config, mesh), make_step(module, rule, config, mesh)
    distances = []
    for _ in range(60):
        arrays = next(batches)
        assert {name: arrays[name].shape for name in ("source", "source_normals", "target", "target_normals")} == {
            **dict.fromkeys(("source", "source_normals"), (2, 30, 3)),
            **dict.fromkeys(("target", "target_normals"), (2, 40, 3)),
        }
        state, scalars = step(state, to_device(arrays, mesh), jax.random.key(0))
        distances.append(float(scalars["distance"]))
    assert np.mean(distances[-20:]) < np.mean(distances[:20])
    found = Predictor(module, 2)({"params": state.params, "batch_stats": state.batch_stats}, [pairs[i] for i in range(3)])
    assert found.R.shape == (3, 3, 3)


def test_a_batch_without_normals_has_none():
    pairs = [pair_of(False)]
    assert set(stack(pairs)) == {"source", "target", "R", "t"}
    batch = to_device(stack(pairs))
    assert (batch.source_normals, batch.target_normals) == (None, None)
