"""Raw data that several tests read: meshes, depth frames, range scans, and real data on machines that have it."""

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data import prepare as preparation
from cmig_jax.data.shards import LOCK


@pytest.fixture
def real_data():
    """Find a folder of real data; without it the test is skipped, since other tests read generated files with the same functions."""

    def find(name: str) -> Path:
        base = Path(os.environ.get("CMIG_SHARED", Path(__file__).resolve().parents[2] / "../shared"))
        for path in (base / "data" / name, base / name):
            if path.is_dir():
                return path
        pytest.skip(f"needs {name}")

    return find


@pytest.fixture(scope="session")
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


@pytest.fixture
def small_shards(monkeypatch) -> None:
    """Put two objects into every shard."""
    monkeypatch.setattr(preparation, "OBJECTS_PER_SHARD", 2)


@pytest.fixture(scope="session")
def prepared_meshes(meshes, tmp_path_factory) -> Path:
    """The meshes with 6 views of 16 pixels, in shards of two; not to be changed."""
    data, views = DataConfig(source="meshes", root=str(meshes)), ViewsConfig(layout="axes", count=6, size=16)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(preparation, "OBJECTS_PER_SHARD", 2)
        return preparation.prepare(data, views, tmp_path_factory.mktemp("meshes") / "prepared", workers=1, progress=False)


@pytest.fixture
def contents():
    """Read every file of a prepared folder."""
    return lambda folder: {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.name != LOCK}


def camera(i: int) -> np.ndarray:
    """World from camera: the camera turns and moves along a wall."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", 0.2 * i, degrees=True).as_matrix()
    pose[:3, 3] = (0.004 * i, 0.002 * i, 0.3)
    return pose


def write_frames(folder: Path, count: int) -> None:
    """Write depth frames of a wall with a step, z = 2 or 2.3 m of the world; the first row and column have no depth."""
    folder.mkdir(parents=True)
    v, u = np.mgrid[:24, :32]
    rays = np.stack([(u - 16) / 20, (v - 12) / 20, np.ones(u.shape)], -1)
    for i in range(count):
        pose = camera(i)
        turned = rays @ pose[:3, :3].T
        far, near = ((wall - pose[2, 3]) / turned[..., 2] for wall in (2.3, 2.0))
        depth = np.round(1000 * np.where(pose[0, 3] + near * turned[..., 0] > 0.2, near, far)).astype(np.uint16)
        depth[0, :], depth[:, 0] = 65535, 0
        Image.fromarray(depth).save(folder / f"frame-{i:06d}.depth.png")
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose)


@pytest.fixture
def frames() -> SimpleNamespace:
    """`write(folder, count)`, `camera(i)` and `intrinsics` of depth frames."""
    return SimpleNamespace(write=write_frames, camera=camera, intrinsics=np.array([[20.0, 0, 16], [0, 20, 12], [0, 0, 1]]))


POSES = [Rotation.from_euler("zyx", [angle, 5 * k, 0], degrees=True) for k, angle in enumerate((0, 30, 100, 0))]
SHIFTS = np.array([[0, 0, 0], [0.1, 0.2, -0.3], [5, 0, 1], [2, 2, 2]])
WORLD = np.random.default_rng(0).normal(size=(3000, 3)) * [1, 0.6, 0.3]
WORLD = WORLD[WORLD[:, 0].argsort()]  # so that a scan is what lies between two planes
PARTS = [slice(0, 1200), slice(400, 1600), slice(1000, 2200), slice(2200, 3000)]


def write_scans(folder: Path, name: str = "toy", unit: float = 1.0) -> Path:
    """Write scans of one cloud, and their `.conf` with x_world = R^T x + t."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["camera 0 0 0 0 0 0 1"]
    for k, (rotation, shift, part) in enumerate(zip(POSES, SHIFTS, PARTS, strict=True)):
        trimesh.PointCloud(unit * (WORLD[part] - shift) @ rotation.as_matrix().T).export(folder / f"{name}{k}.ply")
        lines.append(f"bmesh {name}{k}.ply {' '.join(map(str, (*unit * shift, *rotation.as_quat())))}")
    (folder / f"{name}.conf").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture
def scans() -> SimpleNamespace:
    """`write(folder, name, unit)`, and the `world` cloud, `parts`, `poses` and `shifts` of the scans.

    Scans 0 and 1 share two thirds, 1 and 2 half, 0 and 2 a sixth; 3 shares nothing.
    """
    return SimpleNamespace(write=write_scans, world=WORLD, parts=PARTS, poses=POSES, shifts=SHIFTS)
