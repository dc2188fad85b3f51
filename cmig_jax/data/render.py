"""Depth projections of an object: "project 3D point cloud objects onto various viewpoints" (Sec. III-A).

Cameras stand around the unit sphere and look at its centre. The projection is orthographic, so a view depends on the direction only. A
view is 8 bits, `[H, W]`: 0 is background, 255 the nearest depth the unit ball can have, 1 the farthest, linear in between.

The z-buffer is three array operations per view: points are written in order of depth, so the nearest stays; every point is grown to a
disc by a running maximum (the largest grey is the nearest depth, so this is a z-buffer of discs); and a running minimum shrinks the
result, which keeps the gaps between points closed and the silhouette and the depth close to the true ones.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from scipy.spatial import KDTree

from cmig_jax.clouds import check_cloud
from cmig_jax.config import Layout
from cmig_jax.data.sample import centre

EXTENT = 1.04
"""Half the width of the image plane: the unit ball and a margin for the splats."""
RING_ELEVATION = math.radians(30.0)


def render_views(points: np.ndarray, *, layout: Layout = "dodecahedron", count: int = 20, size: int = 224, fit: bool = False) -> np.ndarray:
    """Render the depth of a point cloud from every camera of a layout.

    Args:
        points: `[P, 3]`, an object in the unit sphere; with `fit`, a cloud in any frame and at any scale.
        layout: positions of the cameras; see `camera_directions`.
        count: number of views V.
        size: height and width of a view, pixels.
        fit: move the mean of the cloud to the origin and scale its largest radius to 1 first.

    Returns:
        `[V, H, W]` uint8: 0 background, 1 farthest to 255 nearest.

    Raises:
        ValueError: an empty cloud, a wrong shape, a coordinate that is not finite, or (without `fit`) a point outside the unit sphere.
    """
    points = _checked(points, fit)
    if size < 8:
        raise ValueError(f"size = {size}: expected at least 8 pixels")
    radius = splat_radius(points, size)
    frames = camera_frames(layout, count)
    inside = slice(radius, radius + size)  # a border of background, so that the discs of one row or view never reach the next
    canvas = np.zeros((len(frames), size + 2 * radius, size + 2 * radius), np.uint8)
    _scatter(points, frames, _antipodes(layout, count), canvas, radius)
    trim = max(0, radius - max(1, radius // 3))  # the difference keeps thin rods whole
    grown = _disc_extremum(np.maximum, canvas, radius)
    return np.ascontiguousarray(_disc_extremum(np.minimum, grown, trim)[:, inside, inside])


def camera_directions(layout: Layout, count: int) -> np.ndarray:
    """Return the unit vectors from the object to its cameras, in a fixed order.

    Args:
        layout: `dodecahedron` (its 20 vertices), `ring` (around z, 30 degrees above the xy plane) or `axes` (+x, -x, +y, ...).
        count: number of cameras V.

    Returns:
        `[V, 3]` float64.

    Raises:
        ValueError: an unknown layout, or a count that the layout does not have.
    """
    if layout == "ring" and count >= 1:
        turn = 2 * np.pi * np.arange(count) / count
        flat, rise = math.cos(RING_ELEVATION), math.sin(RING_ELEVATION)
        return np.stack([flat * np.cos(turn), flat * np.sin(turn), np.full(count, rise)], axis=1)
    if layout == "axes" and count == 6:
        return np.kron(np.eye(3), [[1.0], [-1.0]])
    if layout == "dodecahedron" and count == 20:
        return _dodecahedron() / math.sqrt(3.0)
    raise ValueError(f"layout = {layout!r} with count = {count}: expected dodecahedron with 20, axes with 6, or ring with 1 or more")


@functools.lru_cache(maxsize=16)
def camera_frames(layout: Layout, count: int) -> np.ndarray:
    """Return the frames of the cameras: image right, image up, and the direction to the camera (right-handed; z is up).

    Args:
        layout: as in `camera_directions`.
        count: number of cameras V.

    Returns:
        `[V, 3, 3]` float64 rotations; row 0 right, row 1 up, row 2 direction. Read only.
    """
    directions = camera_directions(layout, count)
    upright = np.abs(directions[:, 2:]) > 1 - 1e-6
    reference = np.where(upright, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])
    up = reference - np.sum(reference * directions, axis=1, keepdims=True) * directions
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    frames = np.stack([np.cross(up, directions), up, directions], axis=1)
    frames.flags.writeable = False
    return frames


def splat_radius(points: np.ndarray, size: int) -> int:
    """Return the radius at which discs around the points of a closed surface leave no hole in a view.

    Random points leave a pixel uncovered with probability exp(-points per disc); the radius makes that a hundredth of a pixel per
    view. The density comes from distances to the fourth nearest neighbour.

    Args:
        points: `[P, 3]`, in the unit sphere.
        size: height and width of a view, pixels.

    Returns:
        The radius, pixels: from 1 to an eighth of the view.
    """
    largest = max(1, size // 8)
    neighbour = min(4, len(points) - 1)
    if neighbour == 0:
        return 1
    tree = KDTree(points, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(points[:: 1 + len(points) // 512], k=neighbour + 1)
    pixels_per_unit = size / (2 * EXTENT)
    per_disc = math.log(100 * math.pi * pixels_per_unit**2)
    area_per_point = math.pi * float(np.mean(distance[:, -1] ** 2)) / neighbour
    radius = pixels_per_unit * math.sqrt(per_disc * area_per_point / math.pi)
    return max(1, min(math.ceil(radius - 0.5), largest))


def _checked(points: np.ndarray, fit: bool) -> np.ndarray:
    """Return `[P, 3]` float32 in the unit sphere."""
    points = check_cloud(points)
    if fit:
        centred, _, radius = centre(points)
        return (centred / radius if radius > 0 else np.zeros_like(centred)).astype(np.float32)
    farthest = math.sqrt(float(np.max(np.einsum("pi,pi->p", points, points))))
    if farthest > 1.001:
        raise ValueError(f"a point at radius {farthest:.4g}: expected an object in the unit sphere, or fit=True")
    return points.astype(np.float32)


def _scatter(points: np.ndarray, frames: np.ndarray, antipodes: tuple[int, ...], canvas: np.ndarray, border: int) -> None:
    """Write the nearest grey of every pixel into `canvas [V, H, W]`, inside a border of background."""
    stride = canvas.shape[-1]
    size, corner = stride - 2 * border, border * (stride + 1)
    flat = canvas.reshape(len(canvas), -1)
    scale = np.float32(size / (2 * EXTENT))
    for view, (frame, antipode) in enumerate(zip(frames.astype(np.float32), antipodes, strict=True)):
        if 0 <= antipode < view:  # rendered with its antipode
            continue
        right, up, depth = frame @ points.T
        column = np.clip((right + EXTENT) * scale, 0, size - 1).astype(np.int32)
        row = np.clip((EXTENT - up) * scale, 0, size - 1).astype(np.int32) * stride + corner
        grey = (np.clip(depth, -1, 1) * 127 + 128.5).astype(np.uint8)
        order = np.argsort(grey, kind="stable")  # radix sort; of several writes to a pixel the last, the nearest, stays
        row, column, grey = row[order], column[order], grey[order]
        flat[view][row + column] = grey
        if antipode >= 0:  # seen from behind: mirrored, near and far exchanged
            flat[antipode][(row + (size - 1 - column))[::-1]] = np.negative(grey[::-1])  # 256 - grey, in 8 bits


def _disc_extremum(extremum: np.ufunc, images: np.ndarray, radius: int) -> np.ndarray:
    """Return the maximum or minimum over a disc around every pixel of `[V, H, W]`; pixels beyond an edge are those of the next row."""
    if radius == 0:
        return images
    stride = images.shape[-1]
    spans = [images.ravel()]  # spans[w]: extremum over the columns -w to w
    for width in range(1, radius + 1):
        spans.append(_extended(extremum, spans[-1].copy(), spans[0], width))
    result = spans[radius].copy()
    for rise in range(1, radius + 1):
        _extended(extremum, result, spans[int(math.sqrt((radius + 0.5) ** 2 - rise**2))], rise * stride)
    return result.reshape(images.shape)


def _extended(extremum: np.ufunc, result: np.ndarray, image: np.ndarray, offset: int) -> np.ndarray:
    """Take the extremum of `result [L]` and of `image [L]` shifted by `offset` to either side, in place, and return it."""
    extremum(result[offset:], image[:-offset], out=result[offset:])
    extremum(result[:-offset], image[offset:], out=result[:-offset])
    return result


@functools.lru_cache(maxsize=16)
def _antipodes(layout: Layout, count: int) -> tuple[int, ...]:
    """Return for every camera the index of the one opposite to it, or -1: the two share one projection."""
    cosines = camera_directions(layout, count) @ camera_directions(layout, count).T
    return tuple(int(np.argmin(row)) if row.min() < 1e-9 - 1 else -1 for row in cosines)


def _dodecahedron() -> np.ndarray:
    """Return the 20 vertices, at radius sqrt(3)."""
    signs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], float)
    golden = (1 + math.sqrt(5)) / 2
    cube = [[x, y, z] for x in (1.0, -1.0) for y in (1.0, -1.0) for z in (1.0, -1.0)]
    edge = np.concatenate([np.zeros((4, 1)), signs * [1 / golden, golden]], axis=1)
    return np.concatenate([cube, edge, np.roll(edge, 2, axis=1), np.roll(edge, 1, axis=1)])
