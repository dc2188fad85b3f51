"""Surface sampling is uniform by area; normalised points lie in the unit sphere."""

import numpy as np
import pytest
import trimesh

from cmig_jax.data.raw import RawObject
from cmig_jax.data.sample import normalise, normalise_together, object_points, sample_surface


def _object(geometry, **fields) -> RawObject:
    return RawObject("thing.ply", 3, "train", lambda: geometry, **fields)


def _cloud(count: int) -> np.ndarray:
    return np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32) * 7 + 50


def test_points_lie_on_the_surface():
    points = sample_surface(trimesh.creation.box((2, 4, 6)), 5000, np.random.default_rng(0))
    assert points.shape == (5000, 3)
    assert points.dtype == np.float32
    np.testing.assert_allclose(np.max(np.abs(points) / (1, 2, 3), axis=1), 1, atol=1e-6)


def test_faces_get_points_by_their_area():
    points = sample_surface(trimesh.creation.box((2, 4, 6)), 60000, np.random.default_rng(1))
    share = [np.mean(np.isclose(np.abs(points[:, i]), half)) for i, half in enumerate((1, 2, 3))]
    np.testing.assert_allclose(share, np.array([24, 12, 8]) / 44, atol=0.01)


def test_a_triangle_is_covered_uniformly():
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False)
    points = sample_surface(mesh, 40000, np.random.default_rng(2))
    np.testing.assert_allclose(points.mean(0), [1 / 3, 1 / 3, 0], atol=0.005)
    corner = (points[:, 0] < 0.5) & (points[:, 1] < 0.5)
    assert corner.mean() == pytest.approx(0.5, abs=0.01)
    assert points.sum(1).max() <= 1 + 1e-6


def test_faces_without_area_get_no_points():
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], [[3, 3, 3], [0, 1, 2], [3, 3, 3]], process=False)
    assert sample_surface(mesh, 500, np.random.default_rng(0)).max() <= 1


def test_sampling_is_a_function_of_the_generator():
    mesh = trimesh.creation.icosphere()
    one, same, other = (sample_surface(mesh, 64, np.random.default_rng(seed)) for seed in (4, 4, 5))
    np.testing.assert_array_equal(one, same)
    assert not np.allclose(one, other)


def test_normalise_centres_and_scales_and_can_be_undone():
    points = _cloud(300)
    unit, centre, scale = normalise(points)
    assert unit.dtype == np.float32
    np.testing.assert_allclose(unit.mean(0), 0, atol=1e-6)
    assert np.linalg.norm(unit, axis=1).max() == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(unit * scale + centre, points, rtol=1e-5)
    np.testing.assert_allclose(normalise(unit)[0], unit, atol=1e-6)


def test_normalise_ignores_unit_and_place():
    points = _cloud(100).astype(np.float64)
    np.testing.assert_allclose(normalise(points * 1e-3 + 4)[0], normalise(points)[0], atol=1e-5)


def test_a_shuffled_cloud_gives_its_first_points_in_order():
    points = _cloud(50)
    chosen = object_points(_object(points, shuffled=True), 20, np.random.default_rng(0))
    np.testing.assert_array_equal(chosen, normalise(points)[0][:20])


def test_a_scan_gives_a_random_subset_without_replacement():
    points = np.linspace(0, 1, 300, dtype=np.float32).reshape(100, 3)
    one, same, other = (object_points(_object(points), 40, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
    assert len(np.unique(one, axis=0)) == 40
    assert {tuple(p) for p in one} <= {tuple(p) for p in normalise(points)[0]}


def test_a_mesh_gives_any_number_of_points_in_the_unit_sphere():
    points = object_points(_object(trimesh.creation.box((1, 20, 300))), 777, np.random.default_rng(0))
    assert points.shape == (777, 3)
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(1, abs=1e-6)


def test_too_few_points_name_the_object():
    with pytest.raises(ValueError, match=r"thing\.ply: 50 points; expected at least 51"):
        object_points(_object(_cloud(50), shuffled=True), 51, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.ones((5, 3)), "all 5 points equal"),
        (np.full((5, 3), 1e6) + np.eye(5, 3) * 1e-6, "all 5 points equal"),
        (np.array([[0, 0, 0], [np.nan, 0, 0]]), "point 1 is .nan"),
        (np.array([[0, 0, np.inf]]), "expected finite"),
        (np.zeros((0, 3)), r"shape \(0, 3\)"),
        (np.zeros((5, 2)), r"expected \[P, 3\]"),
        (np.zeros((5, 3), complex), "complex128"),
    ],
)
def test_bad_points_are_errors(points, message):
    with pytest.raises(ValueError, match=message):
        normalise(points)


_TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        (_TRIANGLE, np.zeros((0, 3), int), "0 faces"),
        ([[0, 0, 0]] * 3, [[0, 1, 2]], "surface area 0"),
        ([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], "point 2 is"),
        (_TRIANGLE, [[0, 1, 7]], "vertex 7; expected 0 to 2"),
    ],
)
def test_bad_meshes_are_errors(vertices, faces, message):
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    with pytest.raises(ValueError, match=message):
        sample_surface(mesh, 10, np.random.default_rng(0))
    with pytest.raises(ValueError, match=rf"thing\.ply: .*{message}"):
        object_points(_object(mesh), 10, np.random.default_rng(0))


def test_no_points_asked_for_is_an_error():
    with pytest.raises(ValueError, match="count = 0"):
        sample_surface(trimesh.creation.box(), 0, np.random.default_rng(0))


def test_two_clouds_are_centred_each_and_scaled_together():
    source, target = _cloud(30), 3 * _cloud(20) - 70
    x, y, centre_x, centre_y, scale = normalise_together(source, target)
    for cloud, normalised, centre in ((source, x, centre_x), (target, y, centre_y)):
        np.testing.assert_allclose(normalised.mean(0), 0, atol=1e-12)
        np.testing.assert_allclose(normalised * scale + centre, cloud, rtol=1e-6)
    assert max(np.linalg.norm(cloud, axis=1).max() for cloud in (x, y)) == pytest.approx(1)
    assert np.linalg.norm(x, axis=1).max() < 0.9  # the smaller cloud stays smaller


def test_two_clouds_of_one_point_each_have_no_scale():
    with pytest.raises(ValueError, match="all points equal"):
        normalise_together(np.ones((4, 3)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match="target: points of shape"):
        normalise_together(np.ones((4, 3)), np.zeros((5, 2)))
