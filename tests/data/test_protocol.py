"""The protocol that turns an object into two clouds: sampling, pose, noise and crop."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig
from cmig_jax.data.protocol import (
    crop,
    draw_pose,
    exponential,
    keep_farthest_along,
    keep_nearest,
    largest_rotation_deg,
    make_clouds,
    mean_angle_deg,
    random_pose,
    samplings,
)

CLEAN = DataConfig(points=100, noise_std=0.0, crop="none")
OBJECT = np.random.default_rng(3).normal(size=(300, 3))
OBJECT = (OBJECT / np.linalg.norm(OBJECT, axis=1).max()).astype(np.float32)


def draw(data, seed=0):
    return make_clouds(OBJECT, data, "thing", np.random.default_rng(seed))


def sorted_rows(points):
    return points[np.lexsort(points.T)]


def undone(pair):
    """Take the target back into the source's frame."""
    return (pair["target"] - pair["t"]) @ pair["R"]


def distances(one, other):
    return np.linalg.norm(one[:, None] - other[None], axis=-1)


def test_a_clean_target_is_the_moved_source_in_another_order():
    pair = draw(CLEAN)
    moved = pair["source"] @ pair["R"].T + pair["t"]
    assert not np.allclose(moved, pair["target"], atol=0.1)
    np.testing.assert_allclose(sorted_rows(moved), sorted_rows(pair["target"]), atol=1e-6)


def test_the_source_lies_in_the_frame_of_the_object():
    np.testing.assert_array_equal(sorted_rows(draw(CLEAN)["source"]), sorted_rows(OBJECT[:100]))
    assert {value.dtype for value in draw(DataConfig(points=100)).values()} == {np.dtype(np.float32)}


@pytest.mark.parametrize(("turn", "lowest", "mean"), [("positive", 0, 22.5), ("either", -45, 0)])
def test_rotations_are_Rx_Ry_Rz_with_every_angle_in_range(turn, lowest, mean):
    rng = np.random.default_rng(0)
    poses = [random_pose(rng, 45.0, 0.5, turn) for _ in range(500)]
    angles = np.stack([Rotation.from_matrix(R).as_euler("XYZ", degrees=True) for R, _ in poses])  # intrinsic: Rx Ry Rz
    shifts = np.stack([t for _, t in poses])
    np.testing.assert_allclose(angles.min(0), lowest, atol=1)
    np.testing.assert_allclose(angles.max(0), 45, atol=1)
    assert lowest <= angles.min() < angles.max() <= 45
    np.testing.assert_allclose(angles.mean(0), mean, atol=4)
    assert mean_angle_deg(DataConfig(turn=turn)) == mean
    largest = np.degrees([Rotation.from_matrix(R).magnitude() for R, _ in poses]).max()
    assert largest <= largest_rotation_deg(DataConfig(turn=turn)) < largest + 12

    assert mean_angle_deg(DataConfig(source="stanford-scans")) == 0
    assert -0.5 <= shifts.min() < -0.49
    assert 0.49 < shifts.max() <= 0.5
    np.testing.assert_allclose(shifts.mean(0), 0, atol=0.05)
    drawn = [Rotation.from_matrix(draw(replace(CLEAN, turn=turn), seed)["R"]).as_euler("XYZ").min() for seed in range(20)]
    assert (min(drawn) < 0) == (turn == "either")


def test_any_rotation_is_uniform_over_the_sphere():
    rng = np.random.default_rng(0)
    turned = np.stack([random_pose(rng, 45.0, 0.5, "any")[0] for _ in range(2_000)])
    np.testing.assert_allclose(turned.mean(axis=0), 0, atol=0.05)
    np.testing.assert_allclose(np.mean(turned**2, axis=0), 1 / 3, atol=0.03)
    assert (mean_angle_deg(DataConfig(turn="any")), largest_rotation_deg(DataConfig(turn="any"))) == (0, 180)


TWISTS = np.random.default_rng(5).normal(size=(4, 6)) * [[1], [3], [1e-5], [0]]


@pytest.mark.parametrize("twist", TWISTS)
def test_the_exponential_of_a_twist_is_where_its_motion_ends_after_a_unit_of_time(twist):
    R, t = exponential(twist)
    np.testing.assert_allclose(R, Rotation.from_rotvec(twist[:3]).as_matrix(), atol=1e-12)
    end = solve_ivp(lambda _, x: np.cross(twist[:3], x) + twist[3:], (0, 1), np.zeros(3), rtol=1e-10, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(t, end, atol=1e-8)
    back = exponential(-twist)
    np.testing.assert_allclose(back[0] @ R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(back[0] @ t + back[1], 0, atol=1e-12)


@pytest.mark.parametrize("longest", [0.8, 2.0])
def test_twists_have_a_uniform_direction_and_a_uniform_length(longest):
    data, rng = DataConfig(pose="twist", max_twist=longest, turn="positive"), np.random.default_rng(0)
    poses = [draw_pose(rng, data) for _ in range(3000)]
    twists = np.array([logarithm(R, t) for R, t in poses])
    length = np.linalg.norm(twists, axis=1)
    assert length.max() <= longest + 1e-9
    np.testing.assert_allclose(
        np.quantile(length, [0.1, 0.25, 0.5, 0.75, 0.9, 1]), longest * np.array([0.1, 0.25, 0.5, 0.75, 0.9, 1]), atol=0.04
    )
    direction = twists / length[:, None]
    np.testing.assert_allclose(direction.mean(0), 0, atol=0.03)
    np.testing.assert_allclose(direction.T @ direction / 3000, np.eye(6) / 6, atol=0.02)
    assert abs(np.corrcoef(length, np.abs(direction[:, 0]))[0, 1]) < 0.06
    largest = np.degrees(np.linalg.norm(twists[:, :3], axis=1)).max()
    assert 0.95 * largest_rotation_deg(data) < largest <= largest_rotation_deg(data) == pytest.approx(np.degrees(longest))
    assert largest_rotation_deg(replace(data, max_twist=4.0)) == 180
    angles = np.stack([Rotation.from_matrix(R).as_euler("XYZ", degrees=True) for R, _ in poses])
    np.testing.assert_allclose(angles.mean(0), mean_angle_deg(data), atol=1.5)


def logarithm(R, t):
    """Return the twist (w, v) of a pose: t = V v, with V the mean of the rotations by s w for s in [0, 1]."""
    w = Rotation.from_matrix(R).as_rotvec()
    V = Rotation.from_rotvec(np.outer((np.arange(40) + 0.5) / 40, w)).as_matrix().mean(axis=0)
    return np.concatenate([w, np.linalg.solve(V, t)])


@pytest.mark.parametrize("seed", range(3))
def test_euler_matrices_multiply_in_the_order_of_the_paper(seed):
    x, y, z = np.random.default_rng(seed).uniform(0, 45, 3)
    R, _ = random_pose(np.random.default_rng(seed), 45.0, 0.5)
    single = [Rotation.from_euler(axis, angle, degrees=True).as_matrix() for axis, angle in zip("xyz", (x, y, z), strict=True)]
    np.testing.assert_allclose(R, single[0] @ single[1] @ single[2], atol=1e-12)


@pytest.mark.parametrize("kind", ["shared", "independent", "half-space", "source", "none"])
@pytest.mark.parametrize("keep", [0.75, 0.501, 0.05, 1.0])
def test_the_crop_keeps_exactly_its_share(kind, keep):
    data = DataConfig(points=100, keep=keep, crop=kind)
    pair = draw(data)
    assert len(pair["source"]) == data.cropped_points == (100 if kind == "none" else round(100 * keep))
    assert len(pair["target"]) == data.target_points == (100 if kind == "source" else data.cropped_points)


def test_a_crop_of_the_source_alone_is_that_of_both_with_a_complete_target():
    data = DataConfig(points=100, keep=0.6)
    both, one, none = (draw(replace(data, crop=kind)) for kind in ("shared", "source", "none"))
    np.testing.assert_array_equal(one["source"], both["source"])
    np.testing.assert_array_equal(one["target"], none["target"])


@pytest.mark.parametrize("keep", [0.75, 0.501, 0.05, 1.0])
def test_the_crops_keep_what_is_near_or_on_one_side_in_its_order(keep):
    points, place = np.random.default_rng(0).normal(size=(1024, 3)), np.array([400.0, -400.5, 400.0])
    distance, count = np.linalg.norm(points - place, axis=1), round(1024 * keep)
    np.testing.assert_array_equal(keep_nearest(points, place, keep), points[distance <= np.sort(distance)[count - 1]])
    height = points @ place
    np.testing.assert_array_equal(keep_farthest_along(points, place, keep), points[height >= np.sort(height)[-count]])


def shared_share(kind):
    """Measure the mean share of one clean cloud's points that the other has too."""
    pairs = [draw(replace(CLEAN, crop=kind, keep=0.75, points=200), seed) for seed in range(60)]
    return np.array([np.mean(distances(undone(pair), pair["source"]).min(1) < 1e-5) for pair in pairs])


def test_one_far_point_overlaps_more_than_two():
    shared, independent, halves = shared_share("shared"), shared_share("independent"), shared_share("half-space")
    assert shared.min() > 0.75
    assert independent.min() < 0.7  # opposite far points: half of what is kept is left
    assert np.any(independent > 0.8)
    assert halves.min() < 0.7
    assert halves.max() > 0.9
    np.testing.assert_array_equal(shared_share("none"), 1)


@pytest.mark.parametrize("sampling", ["once", "twice"])
def test_a_share_drawn_for_each_pair_leaves_equally_many_points_of_a_smaller_part(sampling):
    data = replace(CLEAN, points=80, keep=0.75, keep_least=0.4, crop="shared", sampling=sampling)
    assert data.most_points == 150
    pairs = [draw(data, seed) for seed in range(40)]
    assert {pair[cloud].shape for pair in pairs for cloud in ("source", "target")} == {(60, 3)}
    # Along the diagonal that a crop cuts across, a share of a Gaussian cloud is the shorter the smaller it is.
    diagonal = np.ones(3) / np.sqrt(3)
    lengths = np.array([np.ptp(pair["source"] @ diagonal) for pair in pairs])
    whole = np.mean([np.ptp(draw(replace(data, keep_least=0.75), seed)["source"] @ diagonal) for seed in range(40)])
    assert lengths.mean() < whole
    assert lengths.std() > 0.03


def test_far_points_lie_along_the_diagonal_to_either_side():
    cloud = np.random.default_rng(0).normal(size=(200, 3))
    sides = []
    for seed in range(20):
        kept, same = crop(cloud, cloud, "shared", 0.5, np.random.default_rng(seed))
        np.testing.assert_array_equal(kept, same)
        sides.append(np.sign(kept.sum(1).mean()))
    assert set(sides) == {-1, 1}


def test_half_spaces_have_directions_uniform_on_the_sphere_one_for_each_cloud():
    ball = np.random.default_rng(0).normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    ball = np.concatenate([ball, -ball])  # without a preferred direction
    directions = np.array([[c.mean(0) for c in crop(ball, ball, "half-space", 0.7, np.random.default_rng(i))] for i in range(400)])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    np.testing.assert_allclose(directions.mean(0), 0, atol=0.1)
    np.testing.assert_allclose(np.einsum("nci,ncj->cij", directions, directions) / 400, np.eye(3)[None].repeat(2, 0) / 3, atol=0.06)
    assert abs(np.mean(np.sum(directions[:, 0] * directions[:, 1], -1))) < 0.1  # the two cuts are independent


def test_sampling_twice_takes_the_first_and_the_last_points():
    first, last = samplings(OBJECT, 120, "twice", "thing", np.random.default_rng(0))
    np.testing.assert_array_equal(first, OBJECT[:120])
    np.testing.assert_array_equal(last, OBJECT[-120:])
    pair = draw(replace(CLEAN, sampling="twice"))
    np.testing.assert_allclose(sorted_rows(undone(pair)), sorted_rows(OBJECT[-100:]), atol=1e-6)
    assert distances(undone(pair), pair["source"]).min() > 1e-4


def test_subsets_are_random_and_share_some_points():
    pair = draw(replace(CLEAN, points=200, sampling="subsets"))
    chosen = []
    for cloud in (pair["source"], undone(pair)):
        nearest = distances(cloud, OBJECT)
        assert nearest.min(1).max() < 1e-5
        chosen.append(set(nearest.argmin(1)))
        assert len(chosen[-1]) == 200  # none twice
    assert 100 < len(chosen[0] & chosen[1]) < 165  # 133 of 200 from 300 are expected
    assert max(chosen[0]) > 250


@pytest.mark.parametrize(("sampling", "count"), [("once", 301), ("twice", 151), ("subsets", 301)])
def test_an_object_of_too_few_points_is_named(sampling, count):
    needed = 2 * count if sampling == "twice" else count
    with pytest.raises(
        ValueError, match=f"thing has 300 points: expected at least {needed} for {count} in a cloud and data.sampling={sampling}"
    ):
        draw(replace(CLEAN, points=count, sampling=sampling))


def test_uniform_noise_has_a_deviation_for_each_pair_from_none_to_the_largest():
    data = replace(CLEAN, noise_std=0.02, noise_clip=1.0, noise="uniform")
    deviations = []
    for seed in range(200):
        pair = draw(data, seed)
        gaps = distances(undone(pair), OBJECT[:100]).min(axis=1)
        deviations.append(np.sqrt(np.mean(gaps**2) / 3))  # of three coordinates; a little small where another point is nearer
    assert 0 < min(deviations) < 0.001
    assert 0.017 < max(deviations) < 0.021
    np.testing.assert_allclose(np.quantile(deviations, [0.25, 0.5, 0.75]), [0.005, 0.01, 0.015], atol=0.002)


def test_noise_is_clipped_and_drawn_for_each_cloud():
    pair, clean = draw(replace(CLEAN, noise_std=0.04, noise_clip=0.05)), draw(CLEAN)
    noise = [pair[name] - clean[name] for name in ("source", "target")]
    for cloud in noise:
        assert 0.049 < np.abs(cloud).max() < 0.05 + 1e-6
        np.testing.assert_allclose(cloud.mean(), 0, atol=0.01)
    assert not np.allclose(noise[0], noise[1])
