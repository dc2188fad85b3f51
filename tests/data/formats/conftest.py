"""A cloud with normals and colours, a pose, and a file that is read, moved and read again."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.data.geometry_files import read_geometry, write_moved

UTM = np.array([500_000.0, 5_000_000.0, 100.0])


@dataclass(frozen=True)
class Cloud:
    points: np.ndarray
    normals: np.ndarray
    colours: np.ndarray


@pytest.fixture(scope="session")
def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-1, 1, (40, 3)).round(4), rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points, normals, rng.integers(0, 256, (40, 3)))


@pytest.fixture(scope="session")
def matrix() -> np.ndarray:
    """target_from_source."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    result[:3, 3] = 0.4, -2, 1
    return result


@pytest.fixture(scope="session")
def to_utm(matrix) -> np.ndarray:
    """target_from_source with a target in UTM coordinates."""
    result = matrix.copy()
    result[:3, 3] += UTM
    return result


@pytest.fixture
def read(tmp_path):
    """Return a function that reads bytes or text as a file of a name."""

    def read_as(name: str, content: bytes | str, invalid="error"):
        (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return read_geometry(tmp_path / name, invalid)

    return read_as


@pytest.fixture
def move(tmp_path):
    """Return a function that writes a geometry moved, and returns the path and what is read from it."""

    def moved(source, name: str, target_from_source: np.ndarray, invalid="error"):
        write_moved(tmp_path / name, source, target_from_source)
        return tmp_path / name, read_geometry(tmp_path / name, invalid)

    return moved
