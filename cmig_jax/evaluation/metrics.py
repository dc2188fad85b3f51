"""How far an estimated pose is from the true one (Sec. IV-A).

The paper's errors compare Euler angles and translations component by component. Beside them stand errors that do not depend on the
choice of axes (isotropic) and two that do not depend on the object's symmetry (closest point, and the Chamfer distance of RPM-Net).
n pairs, P points of an object; angles here are in degrees, lengths in units of the normalised object, every pose is
`target_from_source`.
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from cmig_jax.clouds import check_cloud
from cmig_jax.transform import RigidTransform, check_transform

RECALL_DEG = 5.0
RECALL_LENGTH = 0.05
RECALL_CLOSEST_POINT = 0.03
WIDER_RECALLS = {10: 0.1, 15: 0.15}
"""Degrees and lengths of wider recalls: a pose that near is one that a refinement can start from."""

Floats = NDArray[np.float64]


def registration_metrics(
    estimated: RigidTransform, true: RigidTransform, *, closest_point: ArrayLike | None = None, chamfer: ArrayLike | None = None
) -> dict[str, float]:
    """Summarise the errors of n pairs.

    Args:
        estimated: `[n]` poses.
        true: `[n]` poses.
        closest_point: `[n]` of `closest_point_error`, or None to leave its two entries out.
        chamfer: `[n]` of `modified_chamfer`, or None to leave its entry out.

    Returns:
        `rmse_r_deg`, `mae_r_deg` over all Euler angles of all pairs (`euler_errors`); `rmse_t`, `mae_t` over all components;
        `iso_r_deg_mean`, `iso_r_deg_median`, `iso_t_mean`, `iso_t_median` (`isotropic_errors`); `recall`, the share of pairs below both
        5 degrees and 0.05, `recall_10_deg` below 10 and 0.1, `recall_15_deg` below 15 and 0.15; `closest_point`, its mean, and
        `recall_closest_point`, the share below 0.03; `chamfer`, its mean.

    Raises:
        ValueError: no pair, different numbers of pairs, or a pose that is not valid (not finite, or R not a rotation). An invalid
            estimate is never skipped, since leaving it out would flatter the method.
    """
    estimated, true = check_transform(estimated.R, estimated.t, "estimated"), check_transform(true.R, true.t, "true")
    n = len(estimated.R)
    if estimated.get_batch_axes() != true.get_batch_axes() or estimated.R.ndim != 3 or n == 0:
        raise ValueError(f"poses of shapes {estimated.R.shape} and {true.R.shape}: expected [n, 3, 3] both, n at least 1")
    angles, shifts = euler_errors(estimated.R, true.R), estimated.t - true.t
    iso_r, iso_t = isotropic_errors(estimated, true)
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
    for angle, distance in WIDER_RECALLS.items():
        metrics[f"recall_{angle}_deg"] = np.mean((iso_r < angle) & (iso_t < distance))
    if closest_point is not None:
        distances = _distances(closest_point, n, "closest_point")
        metrics["closest_point"] = np.mean(distances)
        metrics["recall_closest_point"] = np.mean(distances < RECALL_CLOSEST_POINT)
    if chamfer is not None:
        metrics["chamfer"] = np.mean(_distances(chamfer, n, "chamfer"))
    return {name: float(value) for name, value in metrics.items()}


def euler_errors(R_estimated: ArrayLike, R_true: ArrayLike) -> Floats:
    """Return the differences of the Euler angles, extrinsic 'zyx', that is R = Rx Ry Rz.

    The literature subtracts the two triples directly. Here a difference is taken the short way round, into [-180, 180): 179 and
    -179 degrees are 2 apart, not 358. On the paper's protocol the true angles are drawn from [0, 45], so this is the plain
    difference unless an estimated angle is below -135. At gimbal lock the third angle counts as 0 (scipy's choice), for both poses.

    Args:
        R_estimated: `[n, 3, 3]` rotations.
        R_true: `[n, 3, 3]` rotations.

    Returns:
        `[n, 3]` degrees, estimated minus true, about z, y, x.
    """
    difference = _euler_deg(R_estimated) - _euler_deg(R_true)
    return (difference + 180.0) % 360.0 - 180.0


def isotropic_errors(estimated: RigidTransform, true: RigidTransform) -> tuple[Floats, Floats]:
    """Return the angle and the length of the motion between estimated and true poses `[n]`.

    Returns:
        `[n]` degrees in [0, 180], the angle of R_true^T R_estimated, and `[n]` |t_estimated - t_true|.
    """
    between = Rotation.from_matrix(true.R).inv() * Rotation.from_matrix(estimated.R)
    return np.degrees(between.magnitude()), np.linalg.norm(estimated.t - true.t, axis=-1)


def closest_point_error(object_points: ArrayLike, estimated: RigidTransform, true: RigidTransform) -> float:
    """Return the mean distance from the object in one pose to its closest point in the other, over both directions.

    A pose that is wrong only by a symmetry of the object counts as right. For a symmetry that does not map the sampled points onto
    each other (any rotation of a cylinder) what remains is the spacing of the sampling, about 0.5 sqrt(area / P): 2,048 points on
    the unit sphere leave 0.039, more than the threshold of the recall; 10,000 leave 0.018. Pass a dense object.

    Args:
        object_points: `[P, 3]` the complete, clean object, in the source's frame.
        estimated: a pose.
        true: a pose.

    Returns:
        The distance, in object units.

    Raises:
        ValueError: the object is empty, not finite or not `[P, 3]`, or a pose is not valid.
    """
    points = check_cloud(object_points, "object_points")
    estimated, true = check_transform(estimated.R, estimated.t, "estimated"), check_transform(true.R, true.t, "true")
    # One tree answers both directions: the object moved by true^-1 estimated, and by its inverse.
    between, tree = true.inverse().compose(estimated), KDTree(points)
    forward, _ = tree.query(between.apply(points))
    backward, _ = tree.query(between.inverse().apply(points))
    return float((np.mean(forward) + np.mean(backward)) / 2)


def modified_chamfer(
    source: ArrayLike, target: ArrayLike, object_points: ArrayLike, estimated: RigidTransform, true: RigidTransform
) -> float:
    """Return the Chamfer distance of a registered pair to the clean object (Yew and Lee, RPM-Net, CVPR 2020).

    The mean squared distance of the moved source to the clean object in its true place in the target's frame, plus that of the target to
    the clean object moved as the source was:

        mean over x of min over p |estimated(x) - true(p)|^2  +  mean over y of min over p |y - estimated(p)|^2

    with x of the source, y of the target and p of the object. It is 0 for a perfect pose of clouds that are points of the object;
    noise of standard deviation s leaves up to 6 s^2 at the perfect pose. A pose that is wrong by a symmetry counts as right, up to
    the spacing of the object's points.

    Args:
        source: `[N, 3]` as observed.
        target: `[M, 3]` as observed.
        object_points: `[P, 3]` the complete, clean object, in the source's frame.
        estimated: a pose.
        true: a pose.

    Returns:
        The distance, in squared object units.

    Raises:
        ValueError: a cloud is empty, not finite or not `[P, 3]`, or a pose is not valid.
    """
    x, y, points = (check_cloud(*c) for c in ((source, "source"), (target, "target"), (object_points, "object_points")))
    estimated, true = check_transform(estimated.R, estimated.t, "estimated"), check_transform(true.R, true.t, "true")
    # Both distances are taken in the object's frame, where one tree answers them.
    tree = KDTree(points)
    forward, _ = tree.query(true.inverse().compose(estimated).apply(x))
    backward, _ = tree.query(estimated.inverse().apply(y))
    return float(np.mean(forward**2) + np.mean(backward**2))


def _distances(values: ArrayLike, count: int, name: str) -> Floats:
    distances = np.asarray(values, np.float64)
    if distances.shape != (count,) or not np.isfinite(distances).all():
        raise ValueError(f"{name} of shape {distances.shape}: expected one finite distance for each of {count} pairs")
    return distances


def _euler_deg(R: ArrayLike) -> Floats:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Gimbal lock", category=UserWarning)
        return Rotation.from_matrix(np.asarray(R, np.float64)).as_euler("zyx", degrees=True)
