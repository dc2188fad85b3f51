"""The protocol that turns an object into a pair: sampling, pose, noise, crop (Sec. IV-B and IV-C), and RPM-Net's variants."""

from __future__ import annotations

import itertools

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from cmig_jax.config import Crop, DataConfig, Sampling, Turn
from cmig_jax.data.sources import source_of

FAR = 500.0  # distance of the crop's far point: from there, "nearest" is a half-space up to rounding
SYMMETRIC = ("bottle", "bowl", "cone", "cup", "flower_pot", "lamp", "tent", "vase")
"""ModelNet40's categories of rotationally symmetric objects; without them 32 are left, a protocol of the literature (`data.exclude`)."""


def make_clouds(
    points: np.ndarray, data: DataConfig, name: object, rng: np.random.Generator, poses: np.random.Generator | None = None
) -> dict[str, np.ndarray]:
    """Draw the two clouds of a pair and the pose between them.

    Args:
        points: `[P, 3]` of the object, normalised; or `[P, 6]` with their unit normals behind.
        data: flags of the protocol.
        name: name of the object in an error.
        rng: random generator.
        poses: random generator of the pose (default: `rng`).

    Returns:
        `source [N, 3]`, `target [M, 3]`, `R [3, 3]`, `t [3]` float32, with target = R source + t; with normals also
        `source_normals [N, 3]` and `target_normals [M, 3]`. Normals change no random number.

    Raises:
        ValueError: the object has too few points for `data.points` and `data.sampling`.
    """
    count = data.points
    if data.keep_least:
        count = round(data.cropped_points / rng.uniform(data.keep_least, data.keep))
    source, target = (cloud[:count] for cloud in samplings(points, data.most_points, data.sampling, name, rng))
    R, t = draw_pose(poses or rng, data)
    clouds = [source, _moved(target, R, t)]
    clouds = [cloud[rng.permutation(len(cloud))] for cloud in clouds]
    if data.noise_std > 0:
        deviation = rng.uniform(0, data.noise_std) if data.noise == "uniform" else data.noise_std
        clouds = [_noisy(cloud, deviation, data.noise_clip, rng) for cloud in clouds]
    keep = data.cropped_points / count if data.keep_least else data.keep
    source, target = crop(clouds[0], clouds[1], data.crop, keep, rng)
    pair = {"source": source[:, :3], "target": target[:, :3], "R": R, "t": t}
    if points.shape[1] == 6:
        pair |= {"source_normals": source[:, 3:], "target_normals": target[:, 3:]}
    return {key: np.ascontiguousarray(value, np.float32) for key, value in pair.items()}


def _moved(rows: np.ndarray, R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Move points `[N, 3]`, and turn the normals behind them `[N, 6]`."""
    points = rows[:, :3] @ R.T + t
    return points if rows.shape[1] == 3 else np.concatenate([points, rows[:, 3:] @ R.T], axis=1)


def _noisy(rows: np.ndarray, deviation: float, limit: float, rng: np.random.Generator) -> np.ndarray:
    """Add clipped noise to points `[N, 3]`; normals behind them `[N, 6]` stay."""
    points = rows[:, :3] + np.clip(rng.normal(0, deviation, (len(rows), 3)), -limit, limit)
    return points if rows.shape[1] == 3 else np.concatenate([points, rows[:, 3:]], axis=1)


def samplings(points: np.ndarray, count: int, sampling: Sampling, name: object, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return the clean points of both clouds, `[count, 3]` each, or `[count, 6]` with normals.

    `once`: the first `count` points for both. `twice`: the first and the last. `subsets`: two random subsets of all points, as RPM-Net
    draws them (Yew and Lee, CVPR 2020).

    Raises:
        ValueError: fewer points than that, naming the object.
    """
    needed = 2 * count if sampling == "twice" else count
    if len(points) < needed:
        raise ValueError(f"{name} has {len(points)} points: expected at least {needed} for {count} in a cloud and data.sampling={sampling}")
    if sampling == "subsets":
        first, second = (rng.choice(len(points), count, replace=False) for _ in range(2))
        return points[first], points[second]
    return points[:count], points[:count] if sampling == "once" else points[-count:]


def draw_pose(rng: np.random.Generator, data: DataConfig) -> tuple[np.ndarray, np.ndarray]:
    """Draw R `[3, 3]` and t `[3]` as the flags say."""
    if data.pose == "twist":
        return random_twist(rng, data.max_twist)
    return random_pose(rng, data.max_angle_deg, data.max_translation, data.turn)


def random_twist(rng: np.random.Generator, max_twist: float) -> tuple[np.ndarray, np.ndarray]:
    """Draw a twist of uniform direction in six dimensions, its length uniform in [0, max], and return its exponential.

    PointNetLK (Aoki et al., CVPR 2019) draws its poses so. A pose and its inverse are equally likely, so it does not matter which cloud is
    the moved one.
    """
    direction = rng.normal(size=6)
    return exponential(direction / np.linalg.norm(direction) * rng.uniform(0, max_twist))


def exponential(twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R `[3, 3]` and t `[3]` of a twist `[6]`, first the rotation vector w, then v: exp([[w x, v], [0, 0]])."""
    (x, y, z), generator = twist[:3], np.zeros((4, 4))
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = twist[3:]
    pose = expm(generator)
    return pose[:3, :3], pose[:3, 3]


def random_pose(
    rng: np.random.Generator, max_angle_deg: float, max_translation: float, turn: Turn = "positive"
) -> tuple[np.ndarray, np.ndarray]:
    """Draw R = Rx Ry Rz `[3, 3]`, each angle uniform in [0 or -max, max] degrees, and t `[3]` uniform in [-max, max].

    With turn = any, R is uniform over all rotations.
    """
    if turn == "any":
        return random_rotation(rng), rng.uniform(-max_translation, max_translation, 3)
    x, y, z = rng.uniform(-max_angle_deg if turn == "either" else 0, max_angle_deg, 3)
    R = Rotation.from_euler("zyx", [z, y, x], degrees=True).as_matrix()
    return R, rng.uniform(-max_translation, max_translation, 3)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    """Draw R `[3, 3]`, uniform over all rotations."""
    return Rotation.from_quat(rng.normal(size=4)).as_matrix()


def mean_angle_deg(data: DataConfig) -> float:
    """Return the mean of each of the three angles of a pair; 0 in any frame, and for recorded pairs, whose angles have either sign."""
    one_sided = data.pose == "euler" and data.turn == "positive" and data.frame != "any" and not source_of(data).records
    return data.max_angle_deg / 2 if one_sided else 0.0


def largest_rotation_deg(data: DataConfig) -> float:
    """Return the largest angle of a rotation that `draw_pose` draws; of recorded pairs, of those that are kept."""
    if source_of(data).records:
        return data.max_angle_deg
    if data.pose == "twist":
        return min(float(np.degrees(data.max_twist)), 180.0)
    if data.turn == "any" or data.max_angle_deg > 90:
        return 180.0
    corners = itertools.product((-data.max_angle_deg if data.turn == "either" else 0, data.max_angle_deg), repeat=3)
    return float(np.degrees(Rotation.from_euler("zyx", list(corners), degrees=True).magnitude()).max())


def crop(source: np.ndarray, target: np.ndarray, kind: Crop, keep: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Keep the share `keep` of each cloud `[N, 3]`, or `[N, 6]` with normals.

    `shared`, `independent`: the points nearest to a far point, the same for both clouds or one each (lower overlap). `source`: those of
    the source alone; the target stays complete. `half-space`: the points on one side of a plane, one each, with its normal uniform on the
    sphere (RPM-Net, which crops before adding noise).
    """
    if kind == "none":
        return source, target
    if kind == "half-space":
        first, second = (rng.normal(size=3) for _ in range(2))
        return keep_farthest_along(source, first, keep), keep_farthest_along(target, second, keep)
    first = far_point(rng)
    if kind == "source":
        return keep_nearest(source, first, keep), target
    second = first if kind == "shared" else far_point(rng)
    return keep_nearest(source, first, keep), keep_nearest(target, second, keep)


def far_point(rng: np.random.Generator) -> np.ndarray:
    """Draw u + 500 s (1, 1, 1), with u uniform in [0, 1]^3 and s = 1 or -1."""
    return rng.uniform(0, 1, 3) + FAR * rng.choice([-1.0, 1.0])


def keep_nearest(points: np.ndarray, centre: np.ndarray, keep: float) -> np.ndarray:
    """Keep the round(keep * N) points of `[N, 3]` or `[N, 6]` nearest to `centre [3]`, in their order."""
    return _keep_smallest(points, np.sum((points[:, :3].astype(np.float64) - centre) ** 2, axis=1), keep)


def keep_farthest_along(points: np.ndarray, direction: np.ndarray, keep: float) -> np.ndarray:
    """Keep the round(keep * N) points of `[N, 3]` or `[N, 6]` farthest along `direction [3]`, in their order."""
    return _keep_smallest(points, -points[:, :3].astype(np.float64) @ direction, keep)


def _keep_smallest(points: np.ndarray, value: np.ndarray, keep: float) -> np.ndarray:
    count = round(len(points) * keep)
    return points[np.sort(np.argpartition(value, count - 1)[:count])]
