"""Small recordings in the layouts of the Stanford repository and of 7-Scenes."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image


@pytest.fixture(scope="session")
def scans(tmp_path_factory) -> Path:
    """Two range scans of one surface that share most of it, joined by a `.conf`, and a model in a folder beside them."""
    folder = tmp_path_factory.mktemp("stanford")
    (folder / "scans").mkdir()
    points = np.random.default_rng(0).normal(size=(400, 3)) * [1, 0.6, 0.3]
    points = points[points[:, 0].argsort()]
    for name, part in (("a", points[:300]), ("b", points[100:])):
        trimesh.PointCloud(part).export(folder / "scans" / f"{name}.ply")
    (folder / "scans" / "scans.conf").write_text("bmesh a.ply 0 0 0 0 0 0 1\nbmesh b.ply 0 0 0 0 0 0 1\n")
    trimesh.PointCloud(points).export(folder / "model.ply")
    return folder


@pytest.fixture(scope="session")
def scenes(tmp_path_factory) -> Path:
    """Three scenes of two fragments each, whose camera stands still before a slanted wall."""
    folder = tmp_path_factory.mktemp("scenes")
    np.savetxt(folder / "camera-intrinsics.txt", [[20.0, 0, 16], [0, 20, 12], [0, 0, 1]])
    depth = (2000 + 30 * np.mgrid[:24, :32].sum(0)).astype(np.uint16)
    for scene in ("chess", "fire", "office"):
        place = folder / scene / "seq-01"
        place.mkdir(parents=True)
        for i in range(100):
            Image.fromarray(depth).save(place / f"frame-{i:06d}.depth.png")
            np.savetxt(place / f"frame-{i:06d}.pose.txt", np.eye(4))
    return folder
