"""The pose of a network for a user's clouds: what it is given, and which clouds and networks cannot be."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cmig_jax.config import Needs
from cmig_jax.data.normals import observed_normals
from cmig_jax.data.sample import normalise_pair
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


def assert_rotation(R):
    assert R.shape == (3, 3)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-5)


def test_the_pose_of_the_network_is_a_start_or_the_result(network, clouds_of_two_sizes, monkeypatch):
    monkeypatch.setattr(Network, "__call__", still)
    target = clouds_of_two_sizes[1]
    source = target @ Rotation.from_euler("z", 1, degrees=True).as_matrix().T
    np.testing.assert_allclose(register(source, target, network).apply(source), target, atol=1e-3)
    np.testing.assert_allclose(register(source, target, network, refine=False).matrix[:3, :3], np.eye(3), atol=1e-12)


def test_clouds_of_different_size_give_a_rotation_and_a_translation(network, clouds_of_two_sizes):
    pose = register(clouds_of_two_sizes[0], clouds_of_two_sizes[1], network, refine=False).target_from_source
    assert_rotation(pose.R)
    assert np.isfinite(pose.t).all()


def test_more_points_than_the_network_knows_are_thinned_to_its_number(network, clouds_of_two_sizes, monkeypatch):
    sizes = []

    def record(self, pairs):
        sizes.append((len(pairs[0]["source"]), len(pairs[0]["target"])))
        return still(self, pairs)

    monkeypatch.setattr(Network, "__call__", record)
    source, target = clouds_of_two_sizes
    register(source, target, network, refine=False)
    register(source[:20], target, network, refine=False)
    assert sizes == [(36, 36), (20, 36)], "36 of 48 points are left after the crop of its training"


def test_a_network_that_was_trained_with_a_crop_of_the_source_gets_all_points_of_the_target(network, clouds_of_two_sizes, monkeypatch):
    config = dataclasses.replace(network.config, data=dataclasses.replace(network.config.data, crop="source"))
    sizes = []
    monkeypatch.setattr(
        Network, "__call__", lambda self, pairs: sizes.append([len(pairs[0][c]) for c in ("source", "target")]) or still(self, pairs)
    )
    register(*clouds_of_two_sizes, dataclasses.replace(network, config=config), refine=False)
    assert sizes == [[36, 48]]


def test_normals_are_estimated_before_the_clouds_are_thinned_where_the_network_reads_them(network, clouds_of_two_sizes, monkeypatch):
    given = []
    monkeypatch.setattr(Network, "__call__", lambda self, pairs: given.append(pairs[0]) or still(self, pairs))
    register(*clouds_of_two_sizes, network, refine=False)
    monkeypatch.setattr(type(network.config.model), "needs", Needs(points=16, normals=True))
    register(*clouds_of_two_sizes, network, refine=False)
    without, pair = given
    assert not {"source_normals", "target_normals"} & set(without)
    normalised = normalise_pair(*clouds_of_two_sizes)
    for cloud in ("source", "target"):
        np.testing.assert_array_equal(pair[cloud], without[cloud])
        whole = getattr(normalised, cloud)
        at = KDTree(whole).query(pair[cloud])[1]
        assert len(at) < len(whole)
        np.testing.assert_allclose(pair[f"{cloud}_normals"], observed_normals(whole)[at], atol=1e-4)


def test_a_network_that_tests_with_all_points_takes_fewer_than_it_was_trained_with(network, clouds_of_two_sizes):
    model = network.config.model
    every = dataclasses.replace(
        network.config, model=dataclasses.replace(model, keypoints=dataclasses.replace(model.keypoints, test_count=36))
    )
    few = dataclasses.replace(network, config=every, predictor=Predictor(build(every), 1))
    pose = register(clouds_of_two_sizes[0][: FEWEST - 1], clouds_of_two_sizes[1], few, refine=False).target_from_source
    assert_rotation(pose.R)


def test_what_is_no_network_is_refused(clouds_of_two_sizes):
    with pytest.raises(ValueError, match="network = 3: expected what `load` returns, a run folder or a weights file"):
        register(clouds_of_two_sizes[0], clouds_of_two_sizes[1], 3)
    with pytest.raises(ValueError, match="runs/none: expected a run folder"):
        register(clouds_of_two_sizes[0], clouds_of_two_sizes[1], "runs/none")
    with pytest.raises(ValueError, match="refine = False: expected a network"):
        register(*clouds_of_two_sizes, refine=False)


def test_fewer_points_than_neighbours_are_refused(network, clouds_of_two_sizes):
    model = dataclasses.replace(network.config.model, points=dataclasses.replace(network.config.model.points, k=30))
    hungry = dataclasses.replace(network, config=dataclasses.replace(network.config, model=model))
    with pytest.raises(ValueError, match="source has 29 points: expected at least 30"):
        register(clouds_of_two_sizes[0][:29], clouds_of_two_sizes[1], hungry)


def test_a_network_of_complete_objects_views_says_what_it_needs(network, clouds_of_two_sizes):
    config = dataclasses.replace(network.config, views=dataclasses.replace(network.config.views, of="object"))
    with pytest.raises(ValueError, match=r"views\.of=object: .*complete object; expected views\.of = source, target or both"):
        register(clouds_of_two_sizes[0], clouds_of_two_sizes[1], dataclasses.replace(network, config=config))
