"""Surface sampling is uniform by area; normalised points lie in the unit sphere."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from cmig_jax.data.raw import RawObject
from cmig_jax.data.sample import normalise, normalise_pair, sample_surface


def _cloud(count: int) -> np.ndarray:
    return np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32) * 7 + 50


def test_points_lie_on_the_surface_by_area():
    points = sample_surface(trimesh.creation.box((2, 4, 6)), 60000, np.random.default_rng(1))
    assert (points.shape, points.dtype) == ((60000, 3), np.float32)
    np.testing.assert_allclose(np.max(np.abs(points) / (1, 2, 3), axis=1), 1, atol=1e-6)
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
    with pytest.raises(ValueError, match="count = 0"):
        sample_surface(mesh, 0, np.random.default_rng(0))


def test_normalise_centres_and_scales():
    points = _cloud(300)
    unit = normalise(points)
    assert unit.dtype == np.float32
    np.testing.assert_allclose(unit.mean(0), 0, atol=1e-6)
    assert np.linalg.norm(unit, axis=1).max() == pytest.approx(1, abs=1e-6)
    centred = points - points.mean(0, dtype=np.float64)
    np.testing.assert_allclose(unit, centred / np.linalg.norm(centred, axis=1).max(), atol=1e-6)
    np.testing.assert_allclose(normalise(unit), unit, atol=1e-6)


@pytest.mark.parametrize(("unit", "place"), [(1e-3, 4.0), (1.0, 5e6), (1e-2, 5e6)])
def test_normalise_ignores_unit_and_place(unit, place):
    """Also an object of some decimetres in geographic coordinates, northing 5,000 km."""
    points = np.float64(_cloud(100)) - 50
    np.testing.assert_allclose(normalise(points * unit + place), normalise(points), atol=1e-5)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.ones((5, 3)), "all 5 points equal"),
        (np.full((5, 3), 1e6) + np.eye(5, 3) * 1e-6, "all 5 points equal"),
        (np.full((3, 3), 0.1), "all 3 points equal"),
        (np.array([[0, 0, 0], [np.nan, 0, 0]]), "point 1 is .nan"),
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
        RawObject("thing.ply", 3, "train", lambda: mesh).geometry()


def test_two_clouds_are_centred_each_and_scaled_together():
    source, target = _cloud(30), 3 * _cloud(20) - 70
    pair = normalise_pair(source, target)
    clouds = ((source, pair.source, pair.source_centre), (target, pair.target, pair.target_centre))
    for cloud, normalised, centre in clouds:
        np.testing.assert_allclose(normalised.mean(0), 0, atol=1e-12)
        np.testing.assert_allclose(normalised * pair.scale + centre, cloud, rtol=1e-6)
    assert max(np.linalg.norm(cloud, axis=1).max() for cloud in (pair.source, pair.target)) == pytest.approx(1)
    assert np.linalg.norm(pair.source, axis=1).max() < 0.9  # the smaller cloud stays smaller


def test_translations_are_those_between_the_normalised_and_the_original_clouds():
    source = _cloud(30)
    R, t = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix(), np.array([4.0, -2.0, 0.5])
    pair = normalise_pair(source, source @ R.T + t)
    normalised = pair.normalised_translation(R, t)
    np.testing.assert_allclose(pair.source @ R.T + normalised, pair.target, atol=1e-6)
    np.testing.assert_allclose(pair.original_translation(R, normalised), t, atol=1e-9)


@pytest.mark.parametrize("value", [1.0, 0.1])
def test_two_clouds_of_one_point_each_have_no_scale(value):
    with pytest.raises(ValueError, match="all points equal"):
        normalise_pair(np.full((3, 3), value), np.zeros((5, 3)))
    assert normalise_pair(np.full((3, 3), value), np.eye(3)).scale == pytest.approx((2 / 3) ** 0.5)
    with pytest.raises(ValueError, match=r"target: shape \(5, 2\)"):
        normalise_pair(np.ones((4, 3)), np.zeros((5, 2)))
