"""The identity, ICP and generalised ICP on clouds whose pose is known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.baselines import ICP_CUTOFF, ICP_TUNED, Gicp, Icp, Identity, gicp, icp
from cmig_jax.baselines.method import no_motion
from cmig_jax.transform import RigidTransform


@pytest.mark.parametrize(("method", "angle", "shift"), [(ICP_TUNED, 20, 0.1), (Gicp(), 20, 0.1), (ICP_CUTOFF, 0.5, 0.005)])
def test_recovers_a_pose_within_reach(method, angle, shift, pair, errors):
    source, target, true = pair(angle, shift)
    pose = method.register(source, target)
    assert pose.R.shape == (3, 3)
    assert pose.t.shape == (3,)
    assert pose.R.dtype == pose.t.dtype == np.float64
    angle, length = errors(pose, true)
    assert angle < 0.5
    assert length < 0.01


@pytest.mark.parametrize("method", [icp, gicp])
def test_takes_float32_and_a_start(method, pair):
    source, target, true = pair(170, 0.5)
    pose = method(source.astype(np.float32), target.astype(np.float32), max_distance=0.05, start=true)
    np.testing.assert_allclose(pose.R, true.R, atol=1e-3)
    np.testing.assert_allclose(pose.t, true.t, atol=1e-3)


@pytest.mark.parametrize("method", [icp, gicp])
def test_without_points_in_reach_it_stays_at_its_start(method, pair, equal):
    source, _, true = pair(10, 0.1)
    equal(method(source, source + 100, max_distance=0.02, start=true), true)
    equal(Gicp(max_distances=(0.02,)).register(source, source + 100), no_motion())


@pytest.mark.parametrize("method", [ICP_TUNED, Gicp()])
def test_is_deterministic(method, pair, equal):
    source, target, _ = pair(30, 0.2)
    equal(method.register(source, target), method.register(source, target))


def test_gicp_slides_planes_on_planes_where_icp_sticks_to_samples(surface):
    """Two samplings of one surface, slightly apart: no two points correspond, but their planes do."""
    source, target = surface(800, 0), surface(800, 1) + np.array([0.02, 0.0, 0.0])
    of_gicp, of_icp = (np.linalg.norm(method.register(source, target).t - [0.02, 0, 0]) for method in (Gicp(), ICP_TUNED))
    assert of_gicp < 0.5 * of_icp


def test_icp_from_the_mean_of_a_protocol_finds_what_icp_from_the_identity_misses(surface, errors):
    true = RigidTransform(R=Rotation.from_euler("zyx", [90, 80, 100], degrees=True).as_matrix(), t=np.array([0.4, -0.5, 0.3]))
    source = surface(400, 0)
    mean, identity = (errors(method.register(source, true.apply(source)), true)[0] for method in (Icp(start_angle_deg=90.0), Icp()))
    assert mean < 1e-3 < 10 < identity
    settings = json.loads(json.dumps(Icp(start_angle_deg=22.5).settings))
    assert settings["start_angle_deg"] == 22.5
    assert settings["start"] != Icp().settings["start"] == "identity"


def test_identity(surface, equal):
    equal(Identity().register(surface(10, 0), surface(20, 1)), no_motion())


def test_settings_are_those_that_it_runs_with(pair, equal):
    source, target, _ = pair(20, 0.1)
    settings = Icp(max_distances=(None, 0.3), iterations=5).settings
    assert settings["max_distances"] == [None, 0.3]
    assert settings["iterations"] == 5
    assert settings["package"].startswith("small_gicp ")
    first = icp(source, target, max_distance=None, iterations=5)
    second = icp(source, target, max_distance=0.3, iterations=5, start=first)
    equal(Icp(max_distances=(None, 0.3), iterations=5).register(source, target), second)
    for method in (Identity(), Icp(), Gicp()):
        assert json.loads(json.dumps(method.settings)) == method.settings


@pytest.mark.parametrize("method", [Identity(), ICP_CUTOFF, ICP_TUNED, Gicp()])
@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (np.zeros((2, 3)), "2 points; expected at least 3"),
        (np.zeros((5, 2)), r"\(5, 2\)"),
        (np.array([[0, 0, 0], [1, np.nan, 0], [0, 1, 0], [0, 0, 1]]), "point 1 is .*nan"),
    ],
)
def test_degenerate_clouds_are_refused(method, broken, message, surface):
    good = surface(10, 0)
    with pytest.raises(ValueError, match=f"source.*{message}"):
        method.register(broken, good)
    with pytest.raises(ValueError, match=f"target.*{message}"):
        method.register(good, broken)


@pytest.mark.parametrize("method", [ICP_TUNED, Gicp()])
@pytest.mark.parametrize("cloud", [np.ones((20, 3)), np.linspace(0, 1, 20)[:, None] * np.ones(3), np.eye(3)])
def test_equal_collinear_and_few_points_give_some_rotation(method, cloud, surface):
    pose = method.register(cloud, surface(20, 0))
    np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-9)
    assert np.isfinite(pose.t).all()


@pytest.mark.parametrize("cutoff", [0.0, -1.0, np.nan])
def test_settings_out_of_range_are_refused(cutoff, surface):
    clouds = surface(20, 0), surface(20, 1)
    for register in (icp, gicp):
        with pytest.raises(ValueError, match=f"max_distance = {cutoff}: expected a length above 0, or None"):
            register(*clouds, max_distance=cutoff)
        with pytest.raises(ValueError, match="iterations = 0"):
            register(*clouds, max_distance=None, iterations=0)
    with pytest.raises(ValueError, match="max_distance"):
        Gicp(max_distances=(cutoff,)).register(*clouds)


@pytest.mark.parametrize("neighbours", [-1, 0, 2])
def test_too_few_neighbours_for_a_plane_are_refused(neighbours, surface):
    with pytest.raises(ValueError, match=f"neighbours = {neighbours}: expected at least 3"):
        gicp(surface(20, 0), surface(20, 1), max_distance=None, neighbours=neighbours)
    with pytest.raises(ValueError, match="expected at least 3"):
        Gicp(neighbours=neighbours).register(surface(20, 0), surface(20, 1))
