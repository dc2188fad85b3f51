"""ICP and the identity on clouds whose pose is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.baselines import icp, icp_cutoff, icp_tuned, identity
from cmig_jax.metrics import isotropic_errors


def surface(points: int, seed: int) -> np.ndarray:
    """A bent sheet: no symmetry."""
    u, v = np.random.default_rng(seed).uniform(-1, 1, (2, points))
    return np.stack([0.8 * u, 0.5 * v, 0.3 * u**2 - 0.2 * v**3 + 0.2 * np.sin(2 * u * v)], 1)


def pair(angle_deg: float, shift: float):
    R, t = Rotation.from_rotvec(np.radians(angle_deg) * np.array([0.6, 0.0, 0.8])).as_matrix(), shift * np.array([1.0, 0.0, 0.0])
    source = surface(800, 0)
    return source, (source @ R.T + t)[np.random.default_rng(1).permutation(800)][:700], R, t


@pytest.mark.parametrize(("register", "angle", "shift"), [(icp_tuned, 20, 0.1), (icp_cutoff, 0.5, 0.005)])
def test_recovers_a_pose_within_reach(register, angle, shift):
    source, target, R_true, t_true = pair(angle, shift)
    R, t = register(source, target)
    assert R.shape == (3, 3)
    assert t.shape == (3,)
    angle, length = isotropic_errors(R[None], t[None], R_true[None], t_true[None])
    assert angle < 0.5
    assert length < 0.01


def test_takes_float32_and_starts_where_it_is_told():
    source, target, R_true, t_true = pair(170, 0.5)
    R, t = icp(source.astype(np.float32), target.astype(np.float32), max_distance=0.05, start=(R_true, t_true))
    np.testing.assert_allclose(R, R_true, atol=1e-3)
    np.testing.assert_allclose(t, t_true, atol=1e-3)


def test_without_a_partner_in_reach_it_stays_where_it_was():
    source, _, R_true, t_true = pair(10, 0.1)
    R, t = icp(source, source + 100, max_distance=0.02, start=(R_true, t_true))
    np.testing.assert_array_equal(R, R_true)
    np.testing.assert_array_equal(t, t_true)


def test_is_deterministic():
    source, target, *_ = pair(30, 0.2)
    for first, second in zip(icp_tuned(source, target), icp_tuned(source, target), strict=True):
        np.testing.assert_array_equal(first, second)


def test_identity():
    R, t = identity(surface(10, 0), surface(20, 1))
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(t, np.zeros(3))


@pytest.mark.parametrize("register", [identity, icp_cutoff, icp_tuned])
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
def test_degenerate_clouds_are_refused(register, broken, message):
    good = surface(10, 0)
    with pytest.raises(ValueError, match=f"source.*{message}"):
        register(broken, good)
    with pytest.raises(ValueError, match=f"target.*{message}"):
        register(good, broken)


@pytest.mark.parametrize("cloud", [np.ones((20, 3)), np.linspace(0, 1, 20)[:, None] * np.ones(3)])
def test_equal_and_collinear_points_give_some_rotation(cloud):
    R, t = icp_tuned(cloud, surface(20, 0))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.isfinite(t).all()


@pytest.mark.parametrize("setting", [{"max_distance": 0.0}, {"max_distance": -1.0}, {"max_distance": np.nan}])
def test_settings_out_of_range_are_refused(setting):
    with pytest.raises(ValueError, match="max_distance"):
        icp(surface(10, 0), surface(10, 1), **setting)
    with pytest.raises(ValueError, match="iterations = 0"):
        icp(surface(10, 0), surface(10, 1), max_distance=None, iterations=0)
