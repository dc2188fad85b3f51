"""The errors at poses whose errors are known."""

import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.evaluation.metrics import closest_point_error, euler_errors, isotropic_errors, modified_chamfer, registration_metrics
from cmig_jax.transform import RigidTransform


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    return RigidTransform(R=Rotation.random(50, rng=rng).as_matrix(), t=rng.normal(size=(50, 3)))


def pose(R, t=(0.0, 0.0, 0.0)):
    return RigidTransform(R=np.asarray(R, float), t=np.asarray(t, float))


IDENTITY = pose(np.eye(3))


def test_zero_at_the_truth(poses):
    metrics = registration_metrics(poses, poses, closest_point=np.zeros(50), chamfer=np.zeros(50))
    shares = {name: metrics.pop(name) for name in ("recall", "recall_10_deg", "recall_15_deg", "recall_closest_point")}
    assert set(shares.values()) == {1.0}
    np.testing.assert_allclose(list(metrics.values()), 0, atol=1e-5)


def test_a_quarter_turn():
    R_true, t_true = np.eye(3)[None].repeat(2, 0), np.zeros((2, 3))
    R_pred, t_pred = R_true.copy(), t_true.copy()
    R_pred[0], t_pred[0] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [0.3, 0.0, 0.4]
    metrics = registration_metrics(pose(R_pred, t_pred), pose(R_true, t_true))
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
        "recall_10_deg": 0.5,
        "recall_15_deg": 0.5,
    }
    assert metrics == pytest.approx(expected)


def test_recalls_need_both_a_small_angle_and_a_short_shift():
    angles, shifts = [4.9, 5.1, 9.9, 10.1, 14.9, 15.1, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0.051, 0.099, 0.101, 0.151]
    found = pose(
        Rotation.from_rotvec(np.radians(angles)[:, None] * [0, 0, 1]).as_matrix(), np.stack([shifts, np.zeros(10), np.zeros(10)], axis=1)
    )
    metrics = registration_metrics(found, pose(np.eye(3)[None].repeat(10, 0), np.zeros((10, 3))))
    assert (metrics["recall"], metrics["recall_10_deg"], metrics["recall_15_deg"]) == (0.1, 0.5, 0.8)


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
        assert registration_metrics(pose(R, [[0, 0, 0]]), pose(R, [[0, 0, 0]]))["rmse_r_deg"] == pytest.approx(0)


def test_isotropic_errors_do_not_depend_on_the_frame(poses):
    rng = np.random.default_rng(2)
    estimated = pose(Rotation.random(50, rng=rng).as_matrix(), rng.normal(size=(50, 3)))
    turn, shift = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    found = isotropic_errors(*(pose(turn @ p.R, p.t @ turn.T + shift) for p in (estimated, poses)))
    np.testing.assert_allclose(found, isotropic_errors(estimated, poses), atol=1e-9)


def test_closest_point_forgives_a_symmetry_and_nothing_else():
    box = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9) * side for side in (1.0, 0.6, 0.3)]), -1).reshape(-1, 3)
    true = pose(Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix(), [0.1, 0.2, -0.3])
    half_turn, quarter_turn = np.diag([-1.0, -1.0, 1.0]), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert closest_point_error(box, pose(true.R @ half_turn, true.t), true) == pytest.approx(0, abs=1e-12)
    assert closest_point_error(box, pose(true.R @ quarter_turn, true.t), true) > 0.05


def test_closest_point_of_a_shift_and_of_swapped_poses():
    line = np.zeros((5, 3))
    line[:, 0] = np.arange(5.0)
    turned = pose(Rotation.from_euler("y", 0.4).as_matrix(), [0.2, 0.1, 0.0])
    assert closest_point_error(line, pose(np.eye(3), [0, 0.01, 0]), IDENTITY) == pytest.approx(0.01)
    assert closest_point_error(line, turned, IDENTITY) == pytest.approx(closest_point_error(line, IDENTITY, turned))


@pytest.fixture
def pair():
    """Noisy parts of an object, its true pose, and another one."""
    rng = np.random.default_rng(3)
    whole = rng.normal(size=(60, 3))
    true = pose(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    source = whole[:40] + rng.normal(0, 0.02, (40, 3))
    target = true.apply(whole[15:]) + rng.normal(0, 0.02, (45, 3))
    guess = pose(Rotation.from_rotvec([0.1, 0.2, -0.1]).as_matrix() @ true.R, true.t + np.array([0.1, 0.0, -0.05]))
    return {"source": source, "target": target, "whole": whole, "true": true, "guess": guess}


def test_chamfer_is_what_its_definition_says(pair):
    clean_target, clean_source = pair["true"].apply(pair["whole"]), pair["guess"].apply(pair["whole"])
    forward = np.sum((pair["guess"].apply(pair["source"])[:, None] - clean_target) ** 2, -1).min(1)
    backward = np.sum((pair["target"][:, None] - clean_source) ** 2, -1).min(1)
    found = modified_chamfer(pair["source"], pair["target"], pair["whole"], pair["guess"], pair["true"])
    assert found == pytest.approx(forward.mean() + backward.mean())
    assert found > 3 * modified_chamfer(pair["source"], pair["target"], pair["whole"], pair["true"], pair["true"])


def test_chamfer_of_clean_parts_is_zero_at_the_truth_and_squares_a_shift(pair):
    whole, true = pair["whole"], pair["true"]
    clean = whole[:40], true.apply(whole[15:])
    assert modified_chamfer(*clean, whole, true, true) == pytest.approx(0, abs=1e-25)
    assert modified_chamfer(*clean, whole, pose(true.R, true.t + np.array([0, 0.01, 0])), true) == pytest.approx(2 * 0.01**2)
    grown = [10 * cloud for cloud in (*clean, whole)]
    error = modified_chamfer(*grown, pose(true.R, 10 * true.t + np.array([0, 0.1, 0])), pose(true.R, 10 * true.t))
    assert error == pytest.approx(2 * 0.1**2)


def test_chamfer_forgives_a_symmetry():
    box = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5) * side for side in (1.0, 0.6, 0.3)]), -1).reshape(-1, 3)
    true = pose(Rotation.from_euler("xyz", [0.3, -0.2, 0.9]).as_matrix(), [0.1, 0.2, -0.3])
    turned = pose(true.R @ np.diag([-1.0, -1.0, 1.0]), true.t)
    assert modified_chamfer(box[:50], true.apply(box[60:]), box, turned, true) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("which", ["source", "target", "whole"])
def test_chamfer_names_a_cloud_that_is_none(pair, which):
    pair[which] = pair[which] * np.nan
    with pytest.raises(ValueError, match=f"{'object_points' if which == 'whole' else which}: point 0 is .* expected finite"):
        modified_chamfer(pair["source"], pair["target"], pair["whole"], pair["true"], pair["true"])


@pytest.mark.parametrize("break_pose", ["nan", "reflection", "scale"])
def test_a_broken_pose_is_named_never_skipped(poses, break_pose):
    R = poses.R.copy()
    R[7] = {"nan": np.full((3, 3), np.nan), "reflection": -np.eye(3), "scale": 2 * np.eye(3)}[break_pose]
    with pytest.raises(ValueError, match=r"estimated\[7\]"):
        registration_metrics(pose(R, poses.t), poses)


def test_wrong_shapes_are_refused(poses):
    for estimated, true in ((poses[0], poses[0]), (poses, poses[:49])):
        with pytest.raises(ValueError, match=r"expected \[n, 3, 3\]"):
            registration_metrics(estimated, true)
    with pytest.raises(ValueError, match="at least 1"):
        registration_metrics(poses[:0], poses[:0])
    with pytest.raises(ValueError, match="each of 50 pairs"):
        registration_metrics(poses, poses, closest_point=np.zeros(49))
    with pytest.raises(ValueError, match="chamfer of shape"):
        registration_metrics(poses, poses, chamfer=np.full(50, np.nan))
    with pytest.raises(ValueError, match="object_points: 0 points; expected at least 1"):
        closest_point_error(np.zeros((0, 3)), poses[0], poses[0])
