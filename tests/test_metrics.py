"""The errors at poses whose errors are known."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.metrics import closest_point_error, euler_errors, isotropic_errors, modified_chamfer, registration_metrics


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    return Rotation.random(50, rng=rng).as_matrix(), rng.normal(size=(50, 3))


def test_zero_at_the_truth(poses):
    metrics = registration_metrics(*poses, *poses, closest_point=np.zeros(50), chamfer=np.zeros(50))
    shares = {name: metrics.pop(name) for name in ("recall", "recall_closest_point")}
    assert shares == {"recall": 1.0, "recall_closest_point": 1.0}
    np.testing.assert_allclose(list(metrics.values()), 0, atol=1e-5)


def test_a_quarter_turn():
    R_true, t_true = np.eye(3)[None].repeat(2, 0), np.zeros((2, 3))
    R_pred, t_pred = R_true.copy(), t_true.copy()
    R_pred[0], t_pred[0] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0.3, 0.0, 0.4]
    metrics = registration_metrics(R_pred, t_pred, R_true, t_true)
    expected = {
        "rmse_r_deg": 90 / np.sqrt(6),
        "mae_r_deg": 15.0,
        "rmse_t": np.sqrt(0.25 / 6),
        "mae_t": 0.7 / 6,
        "iso_r_deg_mean": 45.0,
        "iso_r_deg_median": 45.0,
        "iso_t_mean": 0.25,
        "iso_t_median": 0.25,
        "recall": 0.5,
    }
    assert metrics == pytest.approx(expected)


def test_euler_angles_are_those_the_pairs_are_drawn_with():
    angles = np.random.default_rng(1).uniform(0, 45, (20, 3))
    x, y, z = (Rotation.from_euler(axis, angles[:, i, None], degrees=True).as_matrix() for i, axis in enumerate("xyz"))
    np.testing.assert_allclose(euler_errors(x @ y @ z, np.eye(3)[None].repeat(20, 0)), angles[:, ::-1], atol=1e-9)


def test_euler_differences_go_the_short_way_round():
    R = Rotation.from_euler("z", [[179], [-179]], degrees=True).as_matrix()
    np.testing.assert_allclose(euler_errors(R[:1], R[1:]), [[-2, 0, 0]], atol=1e-9)


def test_gimbal_lock_is_silent():
    R = Rotation.from_matrix(np.array([[[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]])).as_matrix()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert registration_metrics(R, np.zeros((1, 3)), R, np.zeros((1, 3)))["rmse_r_deg"] == pytest.approx(0)


def test_isotropic_errors_do_not_depend_on_the_frame(poses):
    R, t = poses
    rng = np.random.default_rng(2)
    R_pred, t_pred = Rotation.random(50, rng=rng).as_matrix(), rng.normal(size=(50, 3))
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    moved = isotropic_errors(turn @ R_pred, t_pred @ turn.T + shift, turn @ R, t @ turn.T + shift)
    np.testing.assert_allclose(moved, isotropic_errors(R_pred, t_pred, R, t), atol=1e-9)


def test_closest_point_forgives_a_symmetry_and_nothing_else():
    box = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9) * side for side in (1.0, 0.6, 0.3)]), -1).reshape(-1, 3)
    R_true, t_true = Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix(), np.array([0.1, 0.2, -0.3])
    half_turn = np.diag([-1.0, -1.0, 1.0])
    assert closest_point_error(box, R_true @ half_turn, t_true, R_true, t_true) == pytest.approx(0, abs=1e-12)
    quarter_turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert closest_point_error(box, R_true @ quarter_turn, t_true, R_true, t_true) > 0.05


def test_closest_point_of_a_shift_and_of_swapped_poses():
    line = np.zeros((5, 3))
    line[:, 0] = np.arange(5.0)
    R, t = Rotation.from_euler("y", 0.4).as_matrix(), np.array([0.2, 0.1, 0.0])
    assert closest_point_error(line, np.eye(3), [0, 0.01, 0], np.eye(3), np.zeros(3)) == pytest.approx(0.01)
    assert closest_point_error(line, R, t, np.eye(3), np.zeros(3)) == pytest.approx(closest_point_error(line, np.eye(3), np.zeros(3), R, t))


def moved(points, R, t):
    return points @ np.transpose(R) + t


@pytest.fixture
def pair():
    """Noisy parts of an object, its true pose, and another one."""
    rng = np.random.default_rng(3)
    whole = rng.normal(size=(60, 3))
    R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    source = whole[:40] + rng.normal(0, 0.02, (40, 3))
    target = moved(whole[15:], R, t) + rng.normal(0, 0.02, (45, 3))
    guess = Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix() @ R, t + np.array([0.1, 0.0, -0.05])
    return {"source": source, "target": target, "whole": whole, "true": (R, t), "guess": guess}


def test_chamfer_is_what_its_definition_says(pair):
    clean_target, clean_source = moved(pair["whole"], *pair["true"]), moved(pair["whole"], *pair["guess"])
    forward = np.sum((moved(pair["source"], *pair["guess"])[:, None] - clean_target) ** 2, -1).min(1)
    backward = np.sum((pair["target"][:, None] - clean_source) ** 2, -1).min(1)
    found = modified_chamfer(pair["source"], pair["target"], pair["whole"], *pair["guess"], *pair["true"])
    assert found == pytest.approx(forward.mean() + backward.mean())
    assert found > 3 * modified_chamfer(pair["source"], pair["target"], pair["whole"], *pair["true"], *pair["true"])


def test_chamfer_of_clean_parts_is_zero_at_the_truth_and_squares_a_shift(pair):
    whole, (R, t) = pair["whole"], pair["true"]
    clean = whole[:40], moved(whole[15:], R, t)
    assert modified_chamfer(*clean, whole, R, t, R, t) == pytest.approx(0, abs=1e-25)
    assert modified_chamfer(*clean, whole, R, t + np.array([0, 0.01, 0]), R, t) == pytest.approx(2 * 0.01**2)
    grown = [10 * cloud for cloud in (whole[:40], moved(whole[15:], R, t), whole)]
    grown_error = modified_chamfer(*grown, R, 10 * t + np.array([0, 0.1, 0]), R, 10 * t)
    assert grown_error == pytest.approx(2 * 0.1**2)


def test_chamfer_forgives_a_symmetry():
    box = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5) * side for side in (1.0, 0.6, 0.3)]), -1).reshape(-1, 3)
    R, t, half_turn = Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix(), np.array([0.1, 0.2, -0.3]), np.diag([-1.0, -1.0, 1.0])
    assert modified_chamfer(box[:50], moved(box[60:], R, t), box, R @ half_turn, t, R, t) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("which", ["source", "target", "whole"])
def test_chamfer_names_a_cloud_that_is_none(pair, which):
    pair[which] = pair[which] * np.nan
    with pytest.raises(ValueError, match=f"{'object_points' if which == 'whole' else which} of shape .*: expected .*finite"):
        modified_chamfer(pair["source"], pair["target"], pair["whole"], *pair["true"], *pair["true"])


@pytest.mark.parametrize("break_pose", ["nan", "reflection", "scale"])
def test_a_broken_pose_is_named_never_skipped(poses, break_pose):
    R, t = poses
    R_pred = R.copy()
    R_pred[7] = {"nan": np.full((3, 3), np.nan), "reflection": -np.eye(3), "scale": 2 * np.eye(3)}[break_pose]
    with pytest.raises(ValueError, match="predicted pose of pair 7"):
        registration_metrics(R_pred, t, R, t)


def test_wrong_shapes_are_refused(poses):
    R, t = poses
    with pytest.raises(ValueError, match=r"expected \[n, 3, 3\]"):
        registration_metrics(R[0], t[0], R[0], t[0])
    with pytest.raises(ValueError, match="at least 1"):
        registration_metrics(R[:0], t[:0], R[:0], t[:0])
    with pytest.raises(ValueError, match="each of 50 pairs"):
        registration_metrics(R, t, R, t, closest_point=np.zeros(49))
    with pytest.raises(ValueError, match="chamfer of shape"):
        registration_metrics(R, t, R, t, chamfer=np.full(50, np.nan))
    with pytest.raises(ValueError, match="P >= 1"):
        closest_point_error(np.zeros((0, 3)), R[0], t[0], R[0], t[0])
