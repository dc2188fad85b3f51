"""7-Scenes (Sec. IV-D): depth frames and camera poses, fused into fragments of 50 frames, each in the frame of its first camera.

Download: RGB-D Dataset 7-Scenes (Microsoft Research), a zip per scene with a zip per sequence in it; or fragments that others have fused,
as PLY files. `docs/data.md` says where they go. Frames are `frame-XXXXXX.depth.png` (16 bit, millimetres, 0 and 65535 mean no depth)
and `frame-XXXXXX.pose.txt` (`[4, 4]` world from camera). Fragments are in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from cmig_jax.config import DataConfig
from cmig_jax.data.geometry_files import read_object_and_normals
from cmig_jax.data.raw import CloudWithNormals, RawDataset, RawObject, RecordedDataset, Recording, Source, existing_folder, visible_files

FRAMES_PER_FRAGMENT = 50
CELL = 0.01
"""Edge of the cells that a fragment keeps one point of, metres; the sensor's noise at 2 m is about as large."""
_INTRINSICS = np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]])
_NO_DEPTH = (0, 65535)
_TEST_SCENE = "office"
_EXPECTED = "a folder of scenes with frame-*.depth.png and frame-*.pose.txt, or with fragment PLYs"


@dataclass(frozen=True)
class _Fragment:
    """A part of a scene: depth frames to fuse, or a file of a fragment that others have fused."""

    name: str
    frames: tuple[Path, ...]
    intrinsics: np.ndarray
    file: Path | None = None

    def read(self) -> trimesh.Trimesh | np.ndarray | CloudWithNormals:
        return self.fuse() if self.file is None else read_object_and_normals(self.file)

    def fuse(self) -> np.ndarray:
        return fuse_frames(self.frames, self.intrinsics)


def open_sevenscenes(data: DataConfig) -> RawDataset:
    """Open scenes, one category each; every fragment is an object.

    A scene is a sub-folder with frames in `seq-XX/` or directly, or with fused fragments (PLY); the root may itself be a scene.
    Office is the test split, the other scenes are the train split. Without an Office, the last scene by name is the test split; a single
    scene is all test.

    Raises:
        ValueError: no such folder, no frames or fragments in it, or a frame without a pose.
    """
    folder = existing_folder(data.root, _EXPECTED)
    scenes = _scenes(folder)
    held = _held_out(scenes)
    objects = [
        RawObject(f"{scene}/{fragment.name}", label, "test" if scene in held else "train", fragment.read)
        for label, (scene, fragments) in enumerate(scenes.items())
        for fragment in fragments
    ]
    objects.sort(key=lambda item: item.split != "train")
    return RawDataset(tuple(scenes), tuple(objects))


def open_fragment_pairs(data: DataConfig) -> RecordedDataset:
    """Open the fragments of the test scenes of `open_sevenscenes`; consecutive fragments of a sequence are candidates.

    Raises:
        ValueError: no such folder, no frames in it, or a test scene of fragments that others have fused, which come without poses.
    """
    folder = existing_folder(data.root, _EXPECTED)
    scenes = _scenes(folder)
    held = _held_out(scenes)
    recordings, candidates = [], []
    for label, (scene, fragments) in enumerate(scenes.items()):
        before = None
        for fragment in fragments if scene in held else []:
            if not fragment.frames:
                raise ValueError(f"{fragment.file}: a fragment without its pose; expected frame-*.depth.png with frame-*.pose.txt")
            sequence = fragment.frames[0].parent
            if before == sequence:
                candidates.append((len(recordings) - 1, len(recordings)))
            recordings.append(Recording(f"{scene}/{fragment.name}", label, fragment.fuse, _pose(fragment.frames[0])))
            before = sequence
    return RecordedDataset(tuple(scenes), tuple(recordings), tuple(candidates))


def fuse_frames(depth_paths: Sequence[str | Path], intrinsics: np.ndarray = _INTRINSICS) -> np.ndarray:
    """Fuse depth frames into one cloud in the frame of the first camera.

    Args:
        depth_paths: frames in order; the file of its pose is in the same folder.
        intrinsics: `[3, 3]` pinhole matrix, pixels.

    Returns:
        `[P, 3]` float32, metres: the mean of the points in each occupied cell of edge `CELL`.

    Raises:
        ValueError: an unreadable frame or pose, or no depth at all.
    """
    seen, first_from_world = [np.zeros((0, 4))], None
    for path in map(Path, depth_paths):
        world_from_camera = _pose(path)
        if first_from_world is None:
            first_from_world = np.linalg.inv(world_from_camera)
        first_from_camera = first_from_world @ world_from_camera
        # einsum runs on one thread: so thin a product gains nothing from more, and every core has a worker already.
        points = np.einsum("pc,rc->pr", _back_project(_depth(path), intrinsics), first_from_camera[:3, :3]) + first_from_camera[:3, 3]
        seen.append(_cells(np.concatenate([points, np.ones((len(points), 1))], -1)))
    fused = _cells(np.concatenate(seen))
    if len(fused) == 0:
        raise ValueError(f"{depth_paths[0] if depth_paths else 'no frames'}: no depth in {len(depth_paths)} frames; expected some")
    return (fused[:, :3] / fused[:, 3:]).astype(np.float32)


def _scenes(folder: Path) -> dict[str, list[_Fragment]]:
    """Return the fragments of every scene, by its name."""
    if any(folder.glob("frame-*.depth.png")) or any(folder.glob("seq-*")) or visible_files(folder, "*.ply"):
        scenes = {folder.resolve().name: _fragments(folder)}
    else:
        scenes = {place.name: found for place in sorted(folder.iterdir()) if place.is_dir() and (found := _fragments(place))}
    if not any(scenes.values()):
        raise ValueError(f"{folder}: no frame-*.depth.png and no fragment *.ply in it; expected scenes as sub-folders, or one scene")
    return scenes


def _held_out(scenes: dict[str, list[_Fragment]]) -> list[str]:
    """Return the scenes to test on."""
    return [name for name in scenes if _TEST_SCENE in name.lower()] or [max(scenes)]


def _fragments(scene: Path) -> list[_Fragment]:
    found = []
    for place in [scene, *sorted(scene.glob("seq-*"))]:
        frames = sorted(place.glob("frame-*.depth.png"))
        intrinsics = _intrinsics(place) if frames else _INTRINSICS
        for path in frames:
            if not _pose_path(path).is_file():
                raise ValueError(f"{_pose_path(path)}: no such file; expected the pose of {path.name}")
        starts = list(range(0, len(frames), FRAMES_PER_FRAGMENT))
        # The few frames left at the end of a sequence show too little of the scene.
        if len(starts) > 1 and len(frames) - starts[-1] < FRAMES_PER_FRAGMENT // 2:
            starts.pop()
        for number, start in enumerate(starts):
            name = f"{place.name}/fragment-{number:03d}" if place != scene else f"fragment-{number:03d}"
            chosen = tuple(frames[start : start + FRAMES_PER_FRAGMENT])
            found.append(_Fragment(name, chosen, intrinsics))
    return found or [_Fragment(path.name, (), _INTRINSICS, path) for path in visible_files(scene, "*.ply")]


def _intrinsics(place: Path) -> np.ndarray:
    """Read the intrinsics file in the folder of the frames or one of the two folders above; without one, return the dataset's."""
    for folder in (place, place.parent, place.parent.parent):
        path = folder / "camera-intrinsics.txt"
        if path.is_file():
            return _matrix(path, 3)
    return _INTRINSICS


def _pose_path(depth_path: Path) -> Path:
    return depth_path.with_name(depth_path.name.replace(".depth.png", ".pose.txt"))


def _pose(depth_path: Path) -> np.ndarray:
    return _matrix(_pose_path(depth_path), 4)


def _matrix(path: Path, size: int) -> np.ndarray:
    try:
        matrix = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: not a readable matrix ({error}); expected {size} lines of {size} numbers") from error
    if matrix.shape != (size, size) or not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-6:
        raise ValueError(f"{path}: {matrix.tolist()}; expected an invertible [{size}, {size}] matrix of finite numbers")
    return matrix


def _depth(path: Path) -> np.ndarray:
    try:
        with Image.open(path) as image:
            depth = np.asarray(image)
    except (OSError, SyntaxError) as error:
        raise ValueError(f"{path}: not a readable PNG ({error}); expected 16-bit depth in millimetres") from error
    if depth.ndim != 2 or depth.dtype.kind not in "iu" or depth.dtype.itemsize < 2:
        raise ValueError(f"{path}: pixels of shape {depth.shape}, {depth.dtype}; expected [H, W] of 16 bits")
    return depth


def _back_project(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(~np.isin(depth, _NO_DEPTH))
    z = depth[v, u] / 1000.0
    return np.stack([(u - intrinsics[0, 2]) * z / intrinsics[0, 0], (v - intrinsics[1, 2]) * z / intrinsics[1, 1], z], -1)


def _cells(rows: np.ndarray) -> np.ndarray:
    """Add up the rows `[P, 4]`, sums of coordinates and their count, of each cell.

    Applied to every frame first, this bounds the memory by the area of the surface instead of the number of pixels.
    """
    cells = np.floor(rows[:, :3] / rows[:, 3:] / CELL).astype(np.int64)
    cells -= cells.min(0, initial=0)
    extent = cells.max(0, initial=0) + 1
    _, index = np.unique((cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2], return_inverse=True)
    return np.stack([np.bincount(index, column) for column in rows.T], -1)


FRAGMENTS = Source("sevenscenes", open_sevenscenes, folder="sevenscenes")
FRAGMENT_PAIRS = Source("sevenscenes-fragments", open_fragment_pairs, records=True, trains=False, folder="sevenscenes")
