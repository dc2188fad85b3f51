"""Registering a user's clouds: of any size and unit, and every kind of cloud or network that cannot be."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.inference.load import Network
from cmig_jax.inference.predictor import Predictor
from cmig_jax.models.base import initial_variables
from cmig_jax.registration.register import register
from cmig_jax.training.state import build
from cmig_jax.transform import RigidTransform

FEWEST = 16  # the tiny network's keypoints


@pytest.fixture(scope="module")
def network(tiny) -> Network:
    """A network that has learnt nothing: what registration promises does not depend on that."""
    module = build(tiny)
    variables = jax.jit(lambda key: initial_variables(module, tiny.model.needs, key))(jax.random.key(0))
    return Network(config=tiny, variables=variables, predictor=Predictor(module, 1), step=0)


def still(self, pairs):
    """Stand for a network that finds the identity."""
    return RigidTransform(R=np.eye(3)[None], t=np.zeros((1, 3)))


@pytest.fixture(scope="module")
def clouds_of_two_sizes():
    rng = np.random.default_rng(0)
    surface = rng.normal(size=(90, 3)) * [1, 0.6, 0.3]
    R = Rotation.from_euler("zyx", [20, 10, 30], degrees=True).as_matrix()
    return surface[:70], surface @ R.T + [0.3, -0.2, 0.1]


@pytest.fixture(scope="module")
def pose(network, clouds_of_two_sizes):
    return register(*clouds_of_two_sizes, network)


def assert_rotation(R):
    assert R.shape == (3, 3)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-5)


def test_the_pose_is_refined_unless_told_otherwise(network, clouds_of_two_sizes, monkeypatch):
    monkeypatch.setattr(Network, "__call__", still)
    target = clouds_of_two_sizes[1]
    source = target @ Rotation.from_euler("z", 1, degrees=True).as_matrix().T
    np.testing.assert_allclose(register(source, target, network).apply(source), target, atol=1e-3)
    np.testing.assert_array_equal(register(source, target, network, refine=False).R, np.eye(3))


def test_clouds_of_different_size_give_a_rotation_and_a_translation(pose):
    assert_rotation(pose.R)
    assert pose.t.shape == (3,)
    assert np.isfinite(pose.t).all()
    assert isinstance(pose.R, np.ndarray)


def test_the_same_clouds_give_the_same_pose_and_are_left_alone(network, clouds_of_two_sizes, pose):
    before = [cloud.copy() for cloud in clouds_of_two_sizes]
    again = register(*clouds_of_two_sizes, network)
    np.testing.assert_array_equal(again.R, pose.R)
    np.testing.assert_array_equal(again.t, pose.t)
    for cloud, copy in zip(clouds_of_two_sizes, before, strict=True):
        np.testing.assert_array_equal(cloud, copy)


@pytest.mark.parametrize("scale", [0.25, 1024.0])
def test_another_unit_scales_the_translation_alone(network, clouds_of_two_sizes, pose, scale):
    # A power of two scales floating-point numbers without rounding, so no correspondence can change.
    source, target = clouds_of_two_sizes
    found = register(source * scale, target * scale, network)
    np.testing.assert_allclose(found.R, pose.R, atol=1e-6)
    np.testing.assert_allclose(found.t, pose.t * scale, atol=1e-6 * scale)


def test_moving_the_clouds_moves_the_pose_with_them(network, pose, clouds_of_two_sizes):
    # Coordinates that are multiples of 2^-20 are added without rounding.
    source, target = (np.round(cloud * 2**20) / 2**20 for cloud in clouds_of_two_sizes)
    still = register(source, target, network)
    from_there, to_there = np.array([16.0, -8.0, 4.0]), np.array([-2.0, 0.0, 32.0])
    moved = register(source + from_there, target + to_there, network)
    np.testing.assert_allclose(moved.R, still.R, atol=1e-5)
    np.testing.assert_allclose(moved.t, still.t + to_there - still.R @ from_there, atol=1e-3)


@pytest.mark.parametrize("kind", [np.float32, np.float16, "list"])
def test_any_numbers_will_do(network, clouds_of_two_sizes, kind):
    source, target = (cloud.tolist() if kind == "list" else cloud.astype(kind) for cloud in clouds_of_two_sizes)
    assert_rotation(register(source, target, network).R)


def test_whole_numbers_and_planes_register(network):
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(7), [5]), axis=-1).reshape(-1, 3)
    assert_rotation(register(grid, grid, network).R)


def test_more_points_than_the_network_knows_are_thinned_to_its_number_or_the_users(network, clouds_of_two_sizes, monkeypatch):
    sizes = []

    def record(self, pairs):
        sizes.append((len(pairs[0]["source"]), len(pairs[0]["target"])))
        return still(self, pairs)

    monkeypatch.setattr(Network, "__call__", record)
    source, target = clouds_of_two_sizes
    register(source, target, network)
    register(source, target, network, points=80)
    register(source[:20], target, network, points=80)
    assert sizes == [(36, 36), (70, 80), (20, 80)], "36 of 48 points are left after the crop of its training"


@pytest.mark.parametrize("points", [0, -1, FEWEST - 1])
def test_thinning_to_fewer_points_than_the_network_needs_is_refused(network, clouds_of_two_sizes, points):
    with pytest.raises(ValueError, match=f"points = {points}: expected at least {FEWEST}"):
        register(*clouds_of_two_sizes, network, points=points)


def test_a_cloud_with_masked_points_is_refused(network, clouds_of_two_sizes):
    source, target = clouds_of_two_sizes
    hidden = np.ma.masked_array(source, np.arange(len(source))[:, None] % [9, 9, 9] == 0)
    with pytest.raises(ValueError, match="source: 24 masked values; expected none"):
        register(hidden, target, network)
    assert_rotation(register(np.ma.masked_array(source), target, network).R)


def test_refinement_slides_planes_on_planes_where_clouds_are_dense(network, monkeypatch):
    """Three faces of a cube, sampled twice and slightly apart: no two points belong together, but their planes do."""
    monkeypatch.setattr(Network, "__call__", still)
    shift = np.array([0.02, 0.01, 0.0])

    def error(count):
        def faces(seed):
            points = np.random.default_rng(seed).uniform(0, 1, (count, 3))
            points[np.arange(count), np.arange(count) % 3] = 0
            return points

        found = register(faces(0) - shift, faces(1), network)
        return np.abs(found.apply(faces(0) - shift) - faces(0)).max()

    assert error(900) < 0.002 < error(90)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_refinement_does_not_depend_on_the_unit(network, clouds_of_two_sizes, monkeypatch, scale):
    monkeypatch.setattr(Network, "__call__", still)
    target = clouds_of_two_sizes[1]
    source = (target - target.mean(axis=0)) @ Rotation.from_euler("z", 1, degrees=True).as_matrix().T
    found = register(scale * source, scale * target, network)
    np.testing.assert_allclose(found.apply(scale * source) / scale, target, atol=1e-3)


def test_a_network_that_tests_with_all_points_takes_fewer_than_it_was_trained_with(network, clouds_of_two_sizes):
    model = network.config.model
    every = dataclasses.replace(
        network.config, model=dataclasses.replace(model, keypoints=dataclasses.replace(model.keypoints, test_count=36))
    )
    few = dataclasses.replace(network, config=every, predictor=Predictor(build(every), 1))
    assert_rotation(register(clouds_of_two_sizes[0][: FEWEST - 1], clouds_of_two_sizes[1], few).R)


@pytest.mark.parametrize("network", ["runs/quickstart", 3])
def test_what_is_no_network_is_refused(clouds_of_two_sizes, network):
    with pytest.raises(ValueError, match=f"network = {network!r}: expected what `load` returns"):
        register(*clouds_of_two_sizes, network)


def line(points):
    return np.linspace([0, 0, 0], [1, 2, 3], points) + 7


def with_value(value):
    cloud = np.random.default_rng(1).normal(size=(40, 3))
    cloud[5, 2] = value
    return cloud


BAD = {
    "empty": (np.zeros((0, 3)), "0 points; expected at least 1"),
    "no points at all": ([], r"shape \(0,\), float64; expected \[N, 3\] real numbers"),
    "fewer points than keypoints": (np.random.default_rng(0).normal(size=(15, 3)), "15 points: expected at least 16"),
    "nan": (with_value(np.nan), r"point 5 is .*nan\]; expected finite coordinates \(1 of 40 points"),
    "infinite": (with_value(np.inf), r"point 5 is .*inf\]; expected finite"),
    "two coordinates": (np.ones((40, 2)), r"shape \(40, 2\), float64; expected \[N, 3\]"),
    "a batch": (np.ones((1, 40, 3)), r"shape \(1, 40, 3\), float64; expected \[N, 3\]"),
    "ragged": ([[1.0, 2.0, 3.0], [1.0, 2.0]], r"expected \[N, 3\] numbers"),
    "strings": (np.full((40, 3), "a"), r"shape \(40, 3\), <U1; expected \[N, 3\] real numbers"),
    "strings of digits": (np.full((40, 3), "1"), r"shape \(40, 3\), <U1; expected \[N, 3\] real numbers"),
    "complex": (np.full((40, 3), 1j), r"complex128; expected \[N, 3\] real numbers"),
    "none": (None, "expected"),
    "all points equal": (np.full((40, 3), 2.5), "all points are equal or on one line"),
    "collinear": (line(40), "all points are equal or on one line"),
    "collinear in single precision": (line(40).astype(np.float32), "all points are equal or on one line"),
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("which", ["source", "target"])
def test_a_bad_cloud_is_refused_by_its_name_and_value(network, clouds_of_two_sizes, name, which):
    cloud, message = BAD[name]
    clouds = dict(zip(("source", "target"), clouds_of_two_sizes, strict=True)) | {which: cloud}
    with pytest.raises(ValueError, match=f"{which}.*{message}"):
        register(clouds["source"], clouds["target"], network)


def test_fewer_points_than_neighbours_are_refused(network, clouds_of_two_sizes):
    model = dataclasses.replace(network.config.model, points=dataclasses.replace(network.config.model.points, k=30))
    hungry = dataclasses.replace(network, config=dataclasses.replace(network.config, model=model))
    with pytest.raises(ValueError, match="source has 29 points: expected at least 30"):
        register(clouds_of_two_sizes[0][:29], clouds_of_two_sizes[1], hungry)


def test_a_network_of_complete_objects_views_says_what_it_needs(network, clouds_of_two_sizes):
    config = dataclasses.replace(network.config, views=dataclasses.replace(network.config.views, of="object"))
    with pytest.raises(ValueError, match=r"views\.of=object: .*complete object; expected views\.of = source, target or both"):
        register(*clouds_of_two_sizes, dataclasses.replace(network, config=config))
