"""Depth projections: known depths, occlusion, closed surfaces, cameras, bad input."""

import numpy as np
import pytest

from cmig_jax.data import render
from cmig_jax.data.render import EXTENT, camera_directions, camera_frames, render_views, splat_radius


def sphere(count: int, radius: float = 1.0, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def box(count: int, half: float = 0.57, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-half, half, size=(count, 3))
    points[np.arange(count), rng.integers(3, size=count)] = half * rng.choice([-1, 1], size=count)
    return points


def plane(z: float, half: float = 0.5, count: int = 8192, seed: int = 0) -> np.ndarray:
    flat = np.random.default_rng(seed).uniform(-half, half, size=(count, 2))
    return np.column_stack([flat, np.full(count, z)])


def grey(depth: np.ndarray) -> np.ndarray:
    """Depth towards the camera in [-1, 1] to grey."""
    return 128 + 127 * depth


def pixel_centres(size: int) -> np.ndarray:
    return ((np.arange(size) + 0.5) / size * 2 - 1) * EXTENT


@pytest.mark.parametrize("z", [-0.7, 0.0, 0.7])
def test_a_plane_has_its_depth_on_both_sides(z):
    views = render_views(plane(z), layout="axes", count=6, size=64)
    centre = views[:, 24:40, 24:40]
    np.testing.assert_allclose(centre[4], grey(z), atol=1)  # from +z
    np.testing.assert_allclose(centre[5], grey(-z), atol=1)  # from -z
    assert (views[:, :8, :8] == 0).all(), "background"
    filled = (views[4] > 0).sum() * (2 * EXTENT / 64) ** 2
    assert 0.97 < filled < (1 + 4 * 2 * EXTENT / 64) ** 2, "the silhouette grows by a pixel or two, no more"


def test_a_sphere_is_closed_and_has_the_depth_of_its_formula():
    views = render_views(sphere(16384))
    squared = pixel_centres(224)[:, None] ** 2 + pixel_centres(224)[None, :] ** 2
    expected = grey(np.sqrt(np.clip(1 - squared, 0, None)))
    assert views.shape == (20, 224, 224)
    assert views.dtype == np.uint8
    assert (views[:, squared < 0.99**2] > 100).all(), "a hole, or the far side seen through one"
    assert (views[:, squared > (1 + 0.03) ** 2] == 0).all(), "background"
    error = np.abs(views.astype(float) - expected)
    assert np.median(error[:, squared < 0.9**2]) <= 1
    assert np.percentile(error[:, squared < 0.7**2], 90) <= 2


@pytest.mark.parametrize(("count", "size"), [(16384, 224), (768, 32), (768, 24), (2048, 64)])
def test_closed_surfaces_have_no_holes(count, size):
    for seed in range(3):
        for points in (sphere(count, seed=seed), box(count, seed=seed)):
            views = render_views(points, layout="ring", count=12, size=size)
            for view, frame in zip(views, camera_frames("ring", 12), strict=True):
                inside = _silhouette(points @ frame[:2].T, size, shrink=0.9)
                assert (view[inside] > 68).all(), "background, or the far side seen through a hole"


def _silhouette(flat: np.ndarray, size: int, shrink: float) -> np.ndarray:
    """Pixels inside the convex outline of projected points, shrunk."""
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    normals = np.stack([np.cos(turn), np.sin(turn)])
    x, y = np.meshgrid(pixel_centres(size), -pixel_centres(size))
    reach = np.stack([x, y], axis=-1) @ normals
    return (reach < shrink * (flat @ normals).max(axis=0)).all(axis=-1)


def test_an_occluder_hides_what_is_behind():
    scene = np.concatenate([plane(-0.5), plane(0.4, half=0.3)])
    near, far = render_views(scene, layout="axes", count=6, size=64)[4:]
    np.testing.assert_allclose(near[28:36, 28:36], grey(0.4), atol=1)
    np.testing.assert_allclose(far[28:36, 28:36], grey(0.5), atol=1)
    assert np.abs(near[32, 16:18].astype(float) - grey(-0.5)).max() <= 1, "beside the occluder"


def test_the_order_of_the_points_does_not_matter(monkeypatch):
    monkeypatch.setattr(render, "splat_radius", lambda *_: 2)
    points = box(2048)
    shuffled = np.random.default_rng(1).permutation(points)
    np.testing.assert_array_equal(render_views(points, size=32), render_views(shuffled, size=32))


@pytest.mark.parametrize(("layout", "count"), [("dodecahedron", 20), ("ring", 12), ("ring", 5), ("axes", 6)])
def test_cameras_stand_on_the_sphere_with_right_handed_frames(layout, count):
    directions, frames = camera_directions(layout, count), camera_frames(layout, count)
    assert directions.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)
    np.testing.assert_allclose(frames[:, 2], directions)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (count, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1)
    distances = np.linalg.norm(directions[:, None] - directions[None], axis=-1) + 3 * np.eye(count)
    nearest = distances.min(axis=1)
    np.testing.assert_allclose(nearest, nearest[0])
    if layout == "ring":
        np.testing.assert_allclose(directions[:, 2], 0.5)


def test_a_turned_object_is_seen_by_turned_cameras(monkeypatch):
    monkeypatch.setattr(render, "splat_radius", lambda *_: 2)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, size=(700, 3)) * [1, 0.6, 0.3] + [0.1, 0.05, 0]
    turn = 2 * np.pi / 12
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    views = render_views(points, layout="ring", count=12, size=48)
    turned = render_views(points @ rotation.T, layout="ring", count=12, size=48)
    same = (np.roll(views, 1, axis=0) == turned).mean()
    assert same > 0.995, "only points at the edge of a pixel may move"
    assert (views == turned).mean() < 0.95


def test_opposite_cameras_share_a_projection_but_not_its_near_side():
    points = np.concatenate([sphere(4096, 0.3) + np.array([0.5, 0.2, 0.1]), box(4096, 0.2)])
    views, directions = render_views(points, size=64), camera_directions("dodecahedron", 20)
    frames = camera_frames("dodecahedron", 20)
    for i in range(20):
        opposite = int(np.argmin(directions @ directions[i]))
        mirrored = views[opposite][:, ::-1]
        assert ((views[i] > 0) == (mirrored > 0)).mean() > 0.99
        assert abs(int(views[i].max()) - grey((points @ frames[i, 2]).max())) <= 1


def test_fit_takes_a_cloud_of_any_frame_and_scale():
    points = sphere(768) * [1, 0.5, 0.4]
    points -= points.mean(axis=0)
    points /= np.linalg.norm(points, axis=1).max()
    moved = 37.0 * points + [100.0, -20.0, 3.0]
    expected = render_views(points, layout="axes", count=6, size=32)
    assert (render_views(moved, layout="axes", count=6, size=32, fit=True) == expected).mean() > 0.99
    one = render_views(np.full((3, 3), 0.1), layout="axes", count=6, size=32, fit=True)
    assert set(np.unique(one)) == {0, 128}, "equal points are a dot"


def test_the_splat_follows_the_density():
    assert splat_radius(sphere(16384), 224) in (6, 7)
    assert splat_radius(sphere(16384, 0.5), 224) < splat_radius(sphere(16384), 224)
    assert splat_radius(sphere(768), 32) <= 4
    assert splat_radius(sphere(1), 32) == 1


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros((5, 2)), r"shape \(5, 2\)"),
        (np.array([[0, 0, np.inf], [0, 0, 0]]), "point 0 is"),
        (np.full((4, 3), 2.0), "radius 3.464"),
    ],
)
def test_bad_clouds_are_refused(points, message):
    with pytest.raises(ValueError, match=message):
        render_views(points, layout="axes", count=6, size=32)


@pytest.mark.parametrize("flags", [{"layout": "axes", "count": 5}, {"layout": "cube"}, {"layout": "ring", "count": 0}, {"size": 0}])
def test_bad_settings_are_refused(flags):
    with pytest.raises(ValueError, match=r"layout|size"):
        render_views(sphere(64), **flags)
