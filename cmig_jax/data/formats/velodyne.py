"""KITTI's and nuScenes' `.bin`: rows of float32 without a header."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cmig_jax.data.formats.content import Parsed, check_single_precision, moved_points

_KITTI_COLUMNS, _NUSCENES_COLUMNS = 4, 5
_FARTHEST = 1e8  # without a header, other data are known by coordinates such as 1e30


@dataclass(frozen=True)
class Velodyne:
    """KITTI's `.bin`: rows `[P, 4]` float32 of x, y, z and intensity (nuScenes' `.pcd.bin` has a fifth, the ring)."""

    rows: np.ndarray

    def moved(self, target_from_source: np.ndarray, suffix: str) -> bytes:
        """Encode as float32."""
        points = moved_points(self.rows[:, :3], target_from_source)
        check_single_precision(points, suffix, ".npy or .ply")
        return np.concatenate([points, self.rows[:, 3:]], axis=1).astype("<f4").tobytes()


def read_bin(content: bytes, suffix: str) -> Parsed:
    """Read KITTI's float32 rows of x, y, z and intensity (`Format.read`)."""
    return _read_rows(content, _KITTI_COLUMNS)


def read_pcd_bin(content: bytes, suffix: str) -> Parsed:
    """Read nuScenes' float32 rows of x, y, z, intensity and ring (`Format.read`)."""
    return _read_rows(content, _NUSCENES_COLUMNS)


def encode_bin(points: np.ndarray, faces: np.ndarray | None, suffix: str) -> bytes:
    """Encode float32 rows of x, y, z and intensity 0 (`Format.encode`)."""
    columns = _NUSCENES_COLUMNS if suffix == ".pcd.bin" else _KITTI_COLUMNS
    return Velodyne(np.pad(points, ((0, 0), (0, columns - 3)))).moved(np.eye(4), suffix)


def _read_rows(content: bytes, columns: int) -> Parsed:
    text = content[:256]
    if len(content) % (4 * columns):
        raise ValueError(f"{len(content)} bytes; expected rows of {columns} float32: x, y, z and intensity")
    if text and all(byte in b"\t\r\n" or 32 <= byte < 127 for byte in text):
        raise ValueError(f"text; expected rows of {columns} float32: x, y, z and intensity")
    rows = np.frombuffer(content, "<f4").reshape(-1, columns)
    largest = np.abs(rows[:, :3][np.isfinite(rows[:, :3])]).max(initial=0)
    if largest > _FARTHEST:
        raise ValueError(
            f"coordinates up to {largest:.3g}, which no scanner gives; expected rows of {columns} float32: x, y, z and intensity"
        )
    return Parsed(rows[:, :3].astype(np.float64), None, Velodyne(rows))
