"""Scans of a street and of a room by generated sensors: rings of a LiDAR and depth images, which see one side of all."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax import RigidTransform, register
from cmig_jax.registration.search import MOST_TILT_DEG, rotations

FAR = 60.0


def cast(boxes, eye, directions):
    """Return how far along rays `[N, 3]` boxes (`[K, 2, 3]`, lowest and highest corner) or the ground z = 0 are; infinite beyond `FAR`."""
    with np.errstate(divide="ignore"):
        distance = np.where(directions[:, 2] < 0, -eye[2] / directions[:, 2], np.inf)
        for low, high in boxes:
            first, second = (low - eye) / directions, (high - eye) / directions
            enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
            distance = np.where((enter > 0) & (enter < leave), np.minimum(distance, enter), distance)
    return np.where(distance < FAR, distance, np.inf)


def street(seed):
    """Ten houses and twenty cars, none within 6 of the origin."""
    rng, boxes = np.random.default_rng(seed), []
    while len(boxes) < 30:
        size = rng.uniform([6, 6, 5], [20, 20, 15]) if len(boxes) < 10 else rng.uniform([1.5, 1.5, 1.2], [4, 4, 2])
        middle = np.append(rng.uniform(-40, 40, 2), size[2] / 2)
        if np.abs(middle[:2]).max() > 6 + size[:2].max() / 2:
            boxes.append([middle - size / 2, middle + size / 2])
    return np.array(boxes)


def lidar(boxes, world_from_sensor: RigidTransform, seed):
    """Scan in the sensor's frame: 32 rings of 360 returns, 2 cm off."""
    rise, round_ = np.meshgrid(np.radians(np.linspace(-25, 10, 32)), np.radians(np.arange(360)), indexing="ij")
    rays = np.stack([np.cos(rise) * np.cos(round_), np.cos(rise) * np.sin(round_), np.sin(rise)], axis=-1).reshape(-1, 3)
    distance = cast(boxes, world_from_sensor.t, rays @ world_from_sensor.R.T)
    distance += np.random.default_rng(seed).normal(0, 0.02, len(rays))
    return (rays * distance[:, None])[np.isfinite(distance)]


def two_scans(turned, seed=0):
    """Return two scans of a street, the second from another place and turned, and target_from_source."""
    first = RigidTransform(R=np.eye(3), t=np.array([0, 0, 1.8]))
    second = RigidTransform(R=turned, t=np.array([3, 1, 1.8]))
    return lidar(street(seed), first, 1), lidar(street(seed), second, 2), second.inverse().compose(first)


def off(found: RigidTransform, true: RigidTransform):
    """Degrees and distance between two poses."""
    return np.degrees(found.inverse().compose(true).angle()), np.linalg.norm(found.t - true.t)


@pytest.mark.parametrize("searched", ["any", "yaw"])
@pytest.mark.parametrize("yaw", [90, 180])
def test_a_lidar_scan_that_was_turned_about_the_vertical(yaw, searched):
    source, target, true = two_scans(Rotation.from_euler("z", yaw, degrees=True).as_matrix())
    found = register(source, target, rotations=searched)
    angle, distance = off(found.target_from_source, true)
    assert angle < 1
    assert distance < 0.2
    assert found.trusted


def test_yaw_keeps_the_vertical_and_takes_its_axis():
    """The pose of a scan that was tilted by more than it allows is none of those found, near as the starts are."""
    tilt = Rotation.from_euler("x", 22, degrees=True).as_matrix()
    source, target, true = two_scans(np.eye(3))
    found = register(source, target @ tilt, rotations="yaw")
    assert not found.trusted
    for pose in (found.target_from_source, *found.alternatives):
        assert np.degrees(np.arccos(pose.R[2, 2].clip(-1, 1))) < MOST_TILT_DEG + 5
    upward = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # y is up
    found = register(source @ upward.T, target @ upward.T, rotations="yaw", up="y")
    angle, _ = off(found.target_from_source, RigidTransform(R=upward @ true.R @ upward.T, t=upward @ true.t))
    assert angle < 1
    with pytest.raises(ValueError, match="up = 'w': expected x, y or z"):
        register(source, target, rotations="yaw", up="w")  # pyright: ignore[reportArgumentType]


def test_turns_about_an_axis_are_spread_evenly():
    turns = Rotation.from_matrix(np.array(rotations(180, np.array([0, 1.0, 0])))).as_rotvec(degrees=True)
    np.testing.assert_allclose(turns[0], 0)
    np.testing.assert_allclose(turns[:, [0, 2]], 0, atol=1e-12)
    np.testing.assert_allclose(np.diff(np.sort(turns[:, 1])), 10, atol=1e-9)
    assert len(turns) == 36
    assert len(rotations(25, np.array([0, 0, 1.0]))) == 5


def depth_image(boxes, world_from_camera: RigidTransform, missing):
    """Return the points `[480 * 640, 3]` of a depth image; pixels without a return are (0, 0, 0), as some cameras give them."""
    v, u = np.indices((480, 640))
    rays = np.stack([(u - 320) / 585, (v - 240) / 585, np.ones_like(u)], axis=-1).reshape(-1, 3)
    depth = cast(boxes, world_from_camera.t, rays @ world_from_camera.R.T)
    depth[missing | ~np.isfinite(depth)] = 0
    return rays * depth[:, None]


def test_depth_images_of_a_room_half_of_whose_pixels_are_missing():
    wall = [[[-4, 3, 0], [4, 3.1, 3]], [[-4, -4, 0], [-3.9, 3, 3]], [[3.9, -4, 0], [4, 3, 3]]]
    furniture = [[[-1, 1.5, 0], [0.2, 2.2, 0.8]], [[0.8, 1, 0], [1.3, 1.6, 0.5]], [[-0.6, 1.7, 0.8], [-0.3, 2, 1.2]]]
    boxes = np.array([*wall, *furniture], float)
    forward = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # the camera's z looks along y of the room
    tilts = [Rotation.from_euler("x", angle, degrees=True).as_matrix() for angle in (-20, -25)]
    turned = Rotation.from_euler("z", 12, degrees=True).as_matrix() @ forward
    first = RigidTransform(R=forward @ tilts[0], t=np.array([0, -1.5, 1.6]))
    second = RigidTransform(R=turned @ tilts[1], t=np.array([0.5, -1.4, 1.7]))
    rng = np.random.default_rng(0)
    source, target = (depth_image(boxes, camera, rng.random(480 * 640) < 0.55) for camera in (first, second))
    angle, distance = off(register(source, target).target_from_source, second.inverse().compose(first))
    assert angle < 1
    assert distance < 0.05
