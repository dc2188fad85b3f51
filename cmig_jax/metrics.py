"""How far an estimated pose is from the true one (Sec. IV-A).

The paper's errors compare Euler angles and translations component by component. Beside them stand errors that do not depend on the
choice of axes (isotropic) and two that do not depend on the object's symmetry (closest point, and the Chamfer distance of RPM-Net).
n pairs, P points of an object; angles here are in degrees, lengths in units of the normalised object, every pose is
`target_from_source`.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

RECALL_DEG = 5.0
RECALL_LENGTH = 0.05
RECALL_CLOSEST_POINT = 0.03

Floats = NDArray[np.float64]


def registration_metrics(
    R_pred: ArrayLike,
    t_pred: ArrayLike,
    R_true: ArrayLike,
    t_true: ArrayLike,
    *,
    closest_point: ArrayLike | None = None,
    chamfer: ArrayLike | None = None,
) -> dict[str, float]:
    """Summarise the errors of n pairs.

    Args:
        R_pred: `[n, 3, 3]` estimated rotations.
        t_pred: `[n, 3]` estimated translations.
        R_true: `[n, 3, 3]` true rotations.
        t_true: `[n, 3]` true translations.
        closest_point: `[n]` of `closest_point_error`, or None to leave its two entries out.
        chamfer: `[n]` of `modified_chamfer`, or None to leave its entry out.

    Returns:
        `rmse_r_deg`, `mae_r_deg` over all Euler angles of all pairs (`euler_errors`); `rmse_t`, `mae_t` over all components;
        `iso_r_deg_mean`, `iso_r_deg_median`, `iso_t_mean`, `iso_t_median` (`isotropic_errors`); `recall`, the share of pairs below both
        5 degrees and 0.05; `closest_point`, its mean, and `recall_closest_point`, the share below 0.03; `chamfer`, its mean.

    Raises:
        ValueError: no pair, a wrong shape, or a pose that is none (not finite, or R no rotation). A broken estimate is never skipped,
            since leaving it out would flatter the method; the message names the pair.
    """
    R_pred, t_pred = check_poses(R_pred, t_pred, "predicted")
    R_true, t_true = check_poses(R_true, t_true, "true")
    if len(R_pred) != len(R_true) or len(R_pred) == 0:
        raise ValueError(f"{len(R_pred)} predicted and {len(R_true)} true poses: expected the same number, at least 1")
    angles, shifts = euler_errors(R_pred, R_true), t_pred - t_true
    iso_r, iso_t = isotropic_errors(R_pred, t_pred, R_true, t_true)
    metrics = {
        "rmse_r_deg": np.sqrt(np.mean(angles**2)),
        "mae_r_deg": np.mean(np.abs(angles)),
        "rmse_t": np.sqrt(np.mean(shifts**2)),
        "mae_t": np.mean(np.abs(shifts)),
        "iso_r_deg_mean": np.mean(iso_r),
        "iso_r_deg_median": np.median(iso_r),
        "iso_t_mean": np.mean(iso_t),
        "iso_t_median": np.median(iso_t),
        "recall": np.mean((iso_r < RECALL_DEG) & (iso_t < RECALL_LENGTH)),
    }
    if closest_point is not None:
        distances = _distances(closest_point, len(R_pred), "closest_point")
        metrics["closest_point"] = np.mean(distances)
        metrics["recall_closest_point"] = np.mean(distances < RECALL_CLOSEST_POINT)
    if chamfer is not None:
        metrics["chamfer"] = np.mean(_distances(chamfer, len(R_pred), "chamfer"))
    return {name: float(value) for name, value in metrics.items()}


def euler_errors(R_pred: ArrayLike, R_true: ArrayLike) -> Floats:
    """Return the differences of the Euler angles, extrinsic 'zyx', that is R = Rx Ry Rz.

    The literature subtracts the two triples as they come. Here a difference is taken the short way round, into [-180, 180): 179 and
    -179 degrees are 2 apart, not 358. On the paper's protocol the true angles are drawn from [0, 45], so this is the plain
    difference unless an estimated angle lies below -135. At gimbal lock the third angle counts as 0 (scipy's choice), for both poses.

    Args:
        R_pred: `[n, 3, 3]` estimated rotations.
        R_true: `[n, 3, 3]` true rotations.

    Returns:
        `[n, 3]` degrees, predicted minus true, about z, y, x.
    """
    difference = _euler_deg(R_pred) - _euler_deg(R_true)
    return (difference + 180.0) % 360.0 - 180.0


def isotropic_errors(R_pred: ArrayLike, t_pred: ArrayLike, R_true: ArrayLike, t_true: ArrayLike) -> tuple[Floats, Floats]:
    """Return the angle and the length of the motion between the estimated and the true poses.

    Args:
        R_pred: `[n, 3, 3]` estimated rotations.
        t_pred: `[n, 3]` estimated translations.
        R_true: `[n, 3, 3]` true rotations.
        t_true: `[n, 3]` true translations.

    Returns:
        `[n]` degrees in [0, 180], the angle of R_true^T R_pred, and `[n]` |t_pred - t_true|.
    """
    between = Rotation.from_matrix(np.asarray(R_true, np.float64)).inv() * Rotation.from_matrix(np.asarray(R_pred, np.float64))
    return np.degrees(between.magnitude()), np.linalg.norm(np.asarray(t_pred, np.float64) - np.asarray(t_true, np.float64), axis=-1)


def closest_point_error(object_points: ArrayLike, R_pred: ArrayLike, t_pred: ArrayLike, R_true: ArrayLike, t_true: ArrayLike) -> float:
    """Return the mean distance from the object in one pose to its closest point in the other, over both directions.

    A pose that is wrong only by a symmetry of the object counts as right. For a symmetry that does not map the sampled points onto
    each other (any turn of a cylinder) what remains is the spacing of the sampling, about 0.5 sqrt(area / P): 2,048 points on
    the unit sphere leave 0.039, more than the threshold of the recall; 10,000 leave 0.018. Pass a dense object.

    Args:
        object_points: `[P, 3]` the complete, clean object, in the source's frame.
        R_pred: `[3, 3]` estimated rotation.
        t_pred: `[3]` estimated translation.
        R_true: `[3, 3]` true rotation.
        t_true: `[3]` true translation.

    Returns:
        The distance, in object units.

    Raises:
        ValueError: the object is empty, not finite or no `[P, 3]`, or a pose is none.
    """
    points = _points(object_points, "object_points")
    (R_p, t_p), (R_t, t_t) = _pose(R_pred, t_pred, "predicted"), _pose(R_true, t_true, "true")
    # Both directions are asked of one tree: the object moved by true^-1 predicted, and by its inverse.
    R, t = R_t.T @ R_p, R_t.T @ (t_p - t_t)
    tree = KDTree(points)
    forward, _ = tree.query(points @ R.T + t)
    backward, _ = tree.query((points - t) @ R)
    return float((np.mean(forward) + np.mean(backward)) / 2)


def modified_chamfer(
    source: ArrayLike,
    target: ArrayLike,
    object_points: ArrayLike,
    R_pred: ArrayLike,
    t_pred: ArrayLike,
    R_true: ArrayLike,
    t_true: ArrayLike,
) -> float:
    """Return the Chamfer distance of a registered pair to the clean object (Yew and Lee, RPM-Net, CVPR 2020).

    The mean squared distance of the moved source to the clean object where it truly is in the target's frame, plus that of the target to
    the clean object moved as the source was:

        mean over x of min over p |pred(x) - true(p)|^2  +  mean over y of min over p |y - pred(p)|^2

    with x of the source, y of the target and p of the object. It is 0 for a perfect pose of clouds that are points of the object;
    noise of standard deviation s leaves up to 6 s^2 at the perfect pose. A pose that is wrong by a symmetry counts as right, to
    within the spacing of the object's points.

    Args:
        source: `[N, 3]` as observed.
        target: `[M, 3]` as observed.
        object_points: `[P, 3]` the complete, clean object, in the source's frame.
        R_pred: `[3, 3]` estimated rotation.
        t_pred: `[3]` estimated translation.
        R_true: `[3, 3]` true rotation.
        t_true: `[3]` true translation.

    Returns:
        The distance, in squared object units.

    Raises:
        ValueError: a cloud is empty, not finite or no `[P, 3]`, or a pose is none.
    """
    clouds = {"source": source, "target": target, "object_points": object_points}
    x, y, points = (_points(cloud, name) for name, cloud in clouds.items())
    (R_p, t_p), (R_t, t_t) = _pose(R_pred, t_pred, "predicted"), _pose(R_true, t_true, "true")
    # Both distances are taken in the object's frame, where one tree answers them.
    tree = KDTree(points)
    forward, _ = tree.query((x @ R_p.T + t_p - t_t) @ R_t)
    backward, _ = tree.query((y - t_p) @ R_p)
    return float(np.mean(forward**2) + np.mean(backward**2))


def check_poses(R: ArrayLike, t: ArrayLike, which: str, *, names: Sequence[object] | None = None) -> tuple[Floats, Floats]:
    """Return poses as float64, or refuse them.

    Args:
        R: `[n, 3, 3]` rotations; the rounding of bfloat16 passes.
        t: `[n, 3]` translations.
        which: what they are, for the message.
        names: n names of the pairs for the message; by default their positions.

    Returns:
        R and t.

    Raises:
        ValueError: a wrong shape, or a pose that is not finite or whose R is no rotation.
    """
    R, t = np.asarray(R, np.float64), np.asarray(t, np.float64)
    if R.ndim != 3 or R.shape[1:] != (3, 3) or t.shape != (len(R), 3):
        raise ValueError(f"{which} poses of shapes {R.shape} and {t.shape}: expected [n, 3, 3] and [n, 3]")
    for i, (rotation, translation) in enumerate(zip(R, t, strict=True)):
        finite = np.isfinite(rotation).all() and np.isfinite(translation).all()
        if not finite or np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.05 or np.linalg.det(rotation) < 0:
            values = f"R = {rotation.tolist()}, t = {translation.tolist()}"
            raise ValueError(
                f"{which} pose of pair {i if names is None else names[i]}: expected a finite rotation and translation, not {values}"
            )
    return R, t


def _pose(R: ArrayLike, t: ArrayLike, which: str) -> tuple[Floats, Floats]:
    rotations, translations = check_poses(np.asarray(R)[None], np.asarray(t)[None], which)
    return rotations[0], translations[0]


def _points(points: ArrayLike, name: str) -> Floats:
    cloud = np.asarray(points, np.float64)
    if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0 or not np.isfinite(cloud).all():
        raise ValueError(f"{name} of shape {cloud.shape}: expected [P, 3] finite coordinates, P >= 1")
    return cloud


def _distances(values: ArrayLike, count: int, name: str) -> Floats:
    distances = np.asarray(values, np.float64)
    if distances.shape != (count,) or not np.isfinite(distances).all():
        raise ValueError(f"{name} of shape {distances.shape}: expected one finite distance for each of {count} pairs")
    return distances


def _euler_deg(R: ArrayLike) -> Floats:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock", category=UserWarning)
        return Rotation.from_matrix(np.asarray(R, np.float64)).as_euler("zyx", degrees=True)
