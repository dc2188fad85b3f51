"""The identity, ICP and generalised ICP on clouds whose pose is known."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.baselines import Gicp, Icp, Identity, gicp, icp, icp_cutoff, icp_tuned, identity
from cmig_jax.metrics import isotropic_errors

gicp_from_afar = Gicp().register


@pytest.mark.parametrize(("register", "angle", "shift"), [(icp_tuned, 20, 0.1), (gicp_from_afar, 20, 0.1), (icp_cutoff, 0.5, 0.005)])
def test_recovers_a_pose_within_reach(register, angle, shift, pair):
    source, target, R_true, t_true = pair(angle, shift)
    R, t = register(source, target)
    assert R.shape == (3, 3)
    assert t.shape == (3,)
    angle, length = isotropic_errors(R[None], t[None], R_true[None], t_true[None])
    assert angle < 0.5
    assert length < 0.01


@pytest.mark.parametrize("method", [icp, gicp])
def test_takes_float32_and_starts_where_it_is_told(method, pair):
    source, target, R_true, t_true = pair(170, 0.5)
    R, t = method(source.astype(np.float32), target.astype(np.float32), max_distance=0.05, start=(R_true, t_true))
    np.testing.assert_allclose(R, R_true, atol=1e-3)
    np.testing.assert_allclose(t, t_true, atol=1e-3)


@pytest.mark.parametrize("method", [icp, gicp])
def test_without_a_partner_in_reach_it_stays_where_it_was(method, pair):
    source, _, R_true, t_true = pair(10, 0.1)
    R, t = method(source, source + 100, max_distance=0.02, start=(R_true, t_true))
    np.testing.assert_array_equal(R, R_true)
    np.testing.assert_array_equal(t, t_true)
    R, t = Gicp(max_distances=(0.02,)).register(source, source + 100)
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(t, np.zeros(3))


@pytest.mark.parametrize("register", [icp_tuned, gicp_from_afar])
def test_is_deterministic(register, pair):
    source, target, *_ = pair(30, 0.2)
    for first, second in zip(register(source, target), register(source, target), strict=True):
        np.testing.assert_array_equal(first, second)


def test_gicp_slides_planes_on_planes_where_icp_sticks_to_samples(surface):
    """Two samplings of one surface, slightly apart: no two points belong together, but their planes do."""
    source, target = surface(800, 0), surface(800, 1) + np.array([0.02, 0.0, 0.0])
    of_gicp, of_icp = (np.linalg.norm(register(source, target)[1] - [0.02, 0, 0]) for register in (gicp_from_afar, icp_tuned))
    assert of_gicp < 0.5 * of_icp


def test_icp_from_the_mean_of_a_protocol_finds_what_icp_from_the_identity_misses(surface):
    R_true, t_true = Rotation.from_euler("zyx", [90, 80, 100], degrees=True).as_matrix(), np.array([0.4, -0.5, 0.3])
    source = surface(400, 0)
    target = source @ R_true.T + t_true
    errors = []
    for method in (Icp(), Icp(start_angle_deg=90.0)):
        R, t = method.register(source, target)
        errors.append(isotropic_errors(R[None], t[None], R_true[None], t_true[None])[0].item())
    assert errors[1] < 1e-3 < 10 < errors[0]
    settings = json.loads(json.dumps(Icp(start_angle_deg=22.5).settings))
    assert settings["start_angle_deg"] == 22.5
    assert settings["start"] != Icp().settings["start"] == "identity"


def test_identity(surface):
    R, t = identity(surface(10, 0), surface(20, 1))
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(t, np.zeros(3))


def test_settings_are_those_that_it_runs_with(pair):
    source, target, *_ = pair(20, 0.1)
    settings = Icp(max_distances=(None, 0.3), iterations=5).settings
    assert settings["max_distances"] == [None, 0.3]
    assert settings["iterations"] == 5
    assert settings["package"].startswith("small_gicp ")
    R, t = icp(source, target, max_distance=None, iterations=5)
    expected = icp(source, target, max_distance=0.3, iterations=5, start=(R, t))
    for found, one in zip(Icp(max_distances=(None, 0.3), iterations=5).register(source, target), expected, strict=True):
        np.testing.assert_array_equal(found, one)
    for method in (Identity(), Icp(), Gicp()):
        assert json.loads(json.dumps(method.settings)) == method.settings


@pytest.mark.parametrize("register", [identity, icp_cutoff, icp_tuned, gicp_from_afar])
@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (np.zeros((0, 3)), r"\(0, 3\)"),
        (np.zeros((2, 3)), r"\(2, 3\).*at least 3 points"),
        (np.zeros((5, 2)), r"\(5, 2\)"),
        (np.array([[0, 0, 0], [1, np.nan, 0], [0, 1, 0], [0, 0, 1]]), "point 1 is .*nan"),
        (np.array([["a", "b", "c"]] * 3), "numbers"),
    ],
)
def test_degenerate_clouds_are_refused(register, broken, message, surface):
    good = surface(10, 0)
    with pytest.raises(ValueError, match=f"source.*{message}"):
        register(broken, good)
    with pytest.raises(ValueError, match=f"target.*{message}"):
        register(good, broken)


@pytest.mark.parametrize("register", [icp_tuned, gicp_from_afar])
@pytest.mark.parametrize("cloud", [np.ones((20, 3)), np.linspace(0, 1, 20)[:, None] * np.ones(3), np.eye(3)])
def test_equal_collinear_and_few_points_give_some_rotation(register, cloud, surface):
    R, t = register(cloud, surface(20, 0))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.isfinite(t).all()


@pytest.mark.parametrize("setting", [{"max_distance": 0.0}, {"max_distance": -1.0}, {"max_distance": np.nan}])
def test_settings_out_of_range_are_refused(setting, surface):
    for method in (icp, gicp):
        with pytest.raises(ValueError, match="max_distance"):
            method(surface(20, 0), surface(20, 1), **setting)
    with pytest.raises(ValueError, match="max_distance"):
        Gicp(max_distances=(setting["max_distance"],)).register(surface(20, 0), surface(20, 1))
    with pytest.raises(ValueError, match="iterations = 0"):
        icp(surface(10, 0), surface(10, 1), max_distance=None, iterations=0)


@pytest.mark.parametrize("neighbours", [-1, 0, 2])
def test_too_few_neighbours_for_a_plane_are_refused(neighbours, surface):
    with pytest.raises(ValueError, match=f"neighbours = {neighbours}: expected at least 3"):
        gicp(surface(20, 0), surface(20, 1), max_distance=None, neighbours=neighbours)
    with pytest.raises(ValueError, match="expected at least 3"):
        Gicp(neighbours=neighbours).register(surface(20, 0), surface(20, 1))
