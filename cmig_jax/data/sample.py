"""Points of an object: uniform sampling of a surface, and the scale of the unit sphere (Sec. IV-B)."""

from __future__ import annotations

import numpy as np
import trimesh

from cmig_jax.data.raw import RawObject, check_mesh, check_points


def object_points(item: RawObject, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return normalised points of an object.

    A mesh is sampled. A cloud in random order (ModelNet40 HDF5) gives its first `count` points as they come, so that its first and last
    1,024 are two independent samplings of 2,048; any other cloud gives a random subset without replacement. A cloud is normalised
    whole, before the choice.

    Args:
        item: the object.
        count: number of points P.
        rng: source of randomness.

    Returns:
        `[P, 3]` float32 in the unit sphere.

    Raises:
        ValueError: bad geometry, or a cloud of fewer than `count` points; the message names the object.
    """
    geometry = item.geometry()
    if isinstance(geometry, trimesh.Trimesh):
        return normalise(sample_surface(geometry, count, rng), item.name)[0]
    if len(geometry) < count:
        raise ValueError(f"{item.name}: {len(geometry)} points; expected at least {count}")
    points = normalise(geometry, item.name)[0]
    if item.shuffled or len(points) == count:
        return points[:count]
    return points[rng.choice(len(points), count, replace=False)]


def sample_surface(mesh: trimesh.Trimesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw points from a surface, uniform by area.

    Args:
        mesh: triangles.
        count: number of points P, at least 1.
        rng: source of randomness; the points are a function of the mesh and its state.

    Returns:
        `[P, 3]` float32 in the units of the mesh, in random order.

    Raises:
        ValueError: no faces, no area, coordinates that are not finite, or `count` below 1.
    """
    if count < 1:
        raise ValueError(f"count = {count}: expected at least 1 point")
    check_mesh(mesh, "mesh")
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    edges = corners[:, 1:] - corners[:, :1]
    area = np.cumsum(np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=-1))
    face = np.searchsorted(area, rng.random(count) * area[-1], side="right").clip(max=len(area) - 1)
    # Reflecting the outer half of the parallelogram keeps the density uniform on the triangle.
    weight = rng.random((count, 2))
    weight = np.where(weight.sum(1, keepdims=True) > 1, 1 - weight, weight)
    return (corners[face, 0] + np.einsum("pe,pec->pc", weight, edges[face])).astype(np.float32)


def normalise(points: np.ndarray, name: object = "points") -> tuple[np.ndarray, np.ndarray, float]:
    """Centre points at their mean and scale them so that the farthest lies on the unit sphere, as ModelNet40 HDF5 does.

    Args:
        points: `[P, 3]`, any unit.
        name: what an error calls them.

    Returns:
        Points `[P, 3]` float32 of largest norm 1; centre `[3]` float64 and scale, with `points = normalised * scale + centre`.

    Raises:
        ValueError: a wrong shape, coordinates that are not finite, or all points equal.
    """
    check_points(points, name)
    exact = np.asarray(points, np.float64)
    centre = exact.mean(0)
    scale = float(np.linalg.norm(exact - centre, axis=-1).max())
    if not scale > np.finfo(np.float32).eps * np.abs(exact).max():
        raise ValueError(f"{name}: all {len(exact)} points equal {exact[0].tolist()}; expected points apart")
    return ((exact - centre) / scale).astype(np.float32), centre, scale


def normalise_together(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
    """Centre two clouds, each at its own mean, and scale both by one factor so that the farthest point lies on the unit sphere.

    Only what each cloud shows is used, so nothing about the transform between them is given away.

    Args:
        source: `[N, 3]`, any unit.
        target: `[M, 3]`, the same unit.

    Returns:
        Both clouds, `[N, 3]` and `[M, 3]` float64; their centres, `[3]` each; the scale. `cloud = normalised * scale + centre`.

    Raises:
        ValueError: a wrong shape, coordinates that are not finite, or all points of both clouds equal to the centres.
    """
    x, y = (np.asarray(check_points(cloud, name), np.float64) for cloud, name in ((source, "source"), (target, "target")))
    centre_x, centre_y = x.mean(0), y.mean(0)
    scale = float(max(np.linalg.norm(x - centre_x, axis=-1).max(), np.linalg.norm(y - centre_y, axis=-1).max()))
    if not scale > 0:
        raise ValueError(f"source and target: all points equal {centre_x.tolist()} and {centre_y.tolist()}; expected points apart")
    return (x - centre_x) / scale, (y - centre_y) / scale, centre_x, centre_y, scale
