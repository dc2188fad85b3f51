"""The protocol that makes a pair of an object: what it keeps, what it draws, and what that is a function of."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import Config, DataConfig, KeypointsConfig, ModelConfig, ViewsConfig
from cmig_jax.data.loader import stack
from cmig_jax.data.pairs import (
    SYMMETRIC,
    Pairs,
    crop,
    evenly_spaced,
    in_categories,
    keep_farthest_along,
    keep_nearest,
    make_pair,
    mean_angle_deg,
    observe,
    random_pose,
    samplings,
    split_validation,
)


@dataclasses.dataclass
class Objects:
    """Random clouds in the unit sphere, 300 points each, 12 objects of 6 categories."""

    labels: np.ndarray = dataclasses.field(default_factory=lambda: np.arange(12, dtype=np.int32) % 6)
    categories: tuple[str, ...] = tuple("abcdef")
    rendered: bool = True

    def points(self, i):
        cloud = np.random.default_rng(i).normal(size=(300, 3))
        return (cloud / np.linalg.norm(cloud, axis=1).max()).astype(np.float32)

    def views(self, i):
        return np.full((6, 16, 16), i, np.uint8) if self.rendered else None


CLEAN = DataConfig(points=100, noise_std=0.0, crop="none")
VIEWS = ViewsConfig(count=6, size=16, layout="axes")


def config(data=CLEAN, views=VIEWS):
    return Config(data=data, views=views, model=ModelConfig(keypoints=KeypointsConfig(count=16)))


def sorted_rows(points):
    return points[np.lexsort(points.T)]


def draw(data, seed=0):
    return make_pair(Objects(), 3, data, np.random.default_rng(seed))


def undone(pair):
    """Take the target back into the source's frame."""
    return (pair["target"] - pair["t"]) @ pair["R"]


def test_a_clean_target_is_the_moved_source_in_another_order():
    pair = draw(CLEAN)
    moved = pair["source"] @ pair["R"].T + pair["t"]
    assert not np.allclose(moved, pair["target"], atol=0.1)
    np.testing.assert_allclose(sorted_rows(moved), sorted_rows(pair["target"]), atol=1e-6)


def test_the_source_lies_in_the_frame_of_the_object():
    pair = draw(CLEAN)
    np.testing.assert_array_equal(sorted_rows(pair["source"]), sorted_rows(Objects().points(3)[:100]))
    np.testing.assert_array_equal(pair["object"], Objects().points(3))
    assert (pair["index"], pair["label"]) == (3, 3)


def test_arrays_are_float32():
    pair = draw(DataConfig(points=100))
    assert {pair[name].dtype for name in ("source", "target", "R", "t", "object")} == {np.dtype(np.float32)}


def test_rotations_are_Rx_Ry_Rz_with_every_angle_in_range():
    rng = np.random.default_rng(0)
    poses = [random_pose(rng, 45.0, 0.5) for _ in range(500)]
    angles = np.stack([Rotation.from_matrix(R).as_euler("XYZ", degrees=True) for R, _ in poses])  # intrinsic: Rx Ry Rz
    shifts = np.stack([t for _, t in poses])
    assert 0 <= angles.min() < 1
    assert 44 < angles.max() <= 45
    assert -0.5 <= shifts.min() < -0.49
    assert 0.49 < shifts.max() <= 0.5
    np.testing.assert_allclose(angles.mean(0), 22.5, atol=2)
    np.testing.assert_allclose(shifts.mean(0), 0, atol=0.05)


def test_clouds_may_turn_to_either_side():
    rng = np.random.default_rng(0)
    poses = [random_pose(rng, 45.0, 0.5, "either") for _ in range(500)]
    angles = np.stack([Rotation.from_matrix(R).as_euler("XYZ", degrees=True) for R, _ in poses])
    assert (angles.min(0) < -44).all()
    assert (angles.max(0) > 44).all()
    np.testing.assert_allclose(angles.mean(0), 0, atol=4)
    pairs = [draw(DataConfig(points=100, turn="either"), seed=seed) for seed in range(20)]
    assert any(Rotation.from_matrix(pair["R"]).as_euler("XYZ").min() < 0 for pair in pairs)


@pytest.mark.parametrize("turn", ["positive", "either"])
def test_the_mean_angle_is_the_mean_of_what_is_drawn(turn):
    rng = np.random.default_rng(0)
    rotations = Rotation.from_matrix([random_pose(rng, 30.0, 0.5, turn)[0] for _ in range(500)])
    drawn = rotations.as_euler("XYZ", degrees=True)
    np.testing.assert_allclose(drawn.mean(0), mean_angle_deg(DataConfig(max_angle_deg=30.0, turn=turn)), atol=2.5)
    assert mean_angle_deg(DataConfig(source="stanford-scans")) == 0


@pytest.mark.parametrize("seed", range(3))
def test_euler_matrices_multiply_in_the_order_of_the_paper(seed):
    x, y, z = np.random.default_rng(seed).uniform(0, 45, 3)
    R, _ = random_pose(np.random.default_rng(seed), 45.0, 0.5)
    single = [Rotation.from_euler(axis, angle, degrees=True).as_matrix() for axis, angle in zip("xyz", (x, y, z), strict=True)]
    np.testing.assert_allclose(R, single[0] @ single[1] @ single[2], atol=1e-12)


@pytest.mark.parametrize("keep", [0.75, 0.501, 0.05, 1.0])
def test_the_crop_keeps_exactly_its_share(keep):
    pair = draw(DataConfig(points=100, keep=keep))
    assert len(pair["source"]) == len(pair["target"]) == round(100 * keep)


def test_the_crop_keeps_the_nearest_points_in_their_order():
    points, centre = np.random.default_rng(0).normal(size=(40, 3)), np.array([400.0, 400.5, 400.0])
    kept = keep_nearest(points, centre, 0.5)
    far = np.argsort(np.linalg.norm(points - centre, axis=1))[20:]
    np.testing.assert_array_equal(kept, np.delete(points, far, axis=0))


def shared_share(kind):
    """Measure the mean share of one clean cloud's points that the other has too."""
    shares = []
    for seed in range(60):
        pair = draw(replace(CLEAN, crop=kind, keep=0.75, points=200), seed)
        distance = np.linalg.norm(undone(pair)[:, None] - pair["source"][None], axis=-1).min(1)
        shares.append(np.mean(distance < 1e-5))
    return np.array(shares)


def test_one_far_point_overlaps_more_than_two():
    shared, independent = shared_share("shared"), shared_share("independent")
    assert shared.min() > 0.75
    assert independent.min() < 0.7  # opposite far points: half of what is kept is left
    assert np.any(independent > 0.8)
    np.testing.assert_array_equal(shared_share("none"), 1)


def test_far_points_lie_along_the_diagonal_to_either_side():
    cloud = np.random.default_rng(0).normal(size=(200, 3))
    sides = []
    for seed in range(20):
        kept, same = crop(cloud, cloud, "shared", 0.5, np.random.default_rng(seed))
        np.testing.assert_array_equal(kept, same)
        sides.append(np.sign(kept.sum(1).mean()))
    assert set(sides) == {-1, 1}


def test_sampling_twice_takes_the_first_and_the_last_points():
    points = Objects().points(0)
    first, last = samplings(points, 120, "twice")
    np.testing.assert_array_equal(first, points[:120])
    np.testing.assert_array_equal(last, points[-120:])
    pair = draw(replace(CLEAN, sampling="twice"))
    np.testing.assert_allclose(sorted_rows(undone(pair)), sorted_rows(Objects().points(3)[-100:]), atol=1e-6)
    assert np.linalg.norm(undone(pair)[:, None] - pair["source"][None], axis=-1).min() > 1e-4


PINNED = {
    "shared": ([-0.53813, -0.0845, 0.33465], [0.07484, -0.268, 0.27869], (64.12, 78.91)),
    "independent": ([-0.53813, -0.0845, 0.33465], [0.78344, 0.04619, 0.19528], (64.12, 62.04)),
    "none": ([-0.1134, 0.05917, 0.49153], [0.07484, -0.268, 0.27869], (68.57, 67.07)),
    "twice": ([-0.53813, -0.0845, 0.33465], [0.33436, 0.20428, 0.29237], (64.12, 52.96)),
}


@pytest.mark.parametrize("protocol", PINNED)
def test_pairs_are_those_that_earlier_results_were_measured_on(protocol):
    flags = {"sampling": "twice"} if protocol == "twice" else {"crop": protocol}
    pair = Pairs(Objects(), np.array([5, 2, 7]), config(DataConfig(points=100, **flags), replace(VIEWS, of="both")), 1234)[1]
    source, target, greys = PINNED[protocol]
    np.testing.assert_allclose(pair["source"][-1], source, atol=2e-5)
    np.testing.assert_allclose(pair["target"][-1], target, atol=2e-5)
    np.testing.assert_allclose(pair["R"][2], [-0.30191, 0.12848, 0.94464], atol=2e-5)
    np.testing.assert_allclose(pair["t"], [0.39281, 0.21245, 0.31663], atol=2e-5)
    np.testing.assert_allclose(pair["views"].mean(axis=(1, 2, 3)), greys, atol=0.5)


@pytest.mark.parametrize(("sampling", "count"), [("once", 301), ("twice", 151), ("subsets", 301)])
def test_an_object_of_too_few_points_is_named(sampling, count):
    needed = 2 * count if sampling == "twice" else count
    with pytest.raises(
        ValueError, match=f"object 3 has 300 points: expected at least {needed} for data.points={count}, sampling={sampling}"
    ):
        draw(replace(CLEAN, points=count, sampling=sampling))


def test_subsets_are_random_and_share_some_points():
    pair = draw(replace(CLEAN, points=200, sampling="subsets"))
    everything = Objects().points(3)
    shares = []
    for cloud in (pair["source"], undone(pair)):
        distance = np.linalg.norm(cloud[:, None] - everything[None], axis=-1)
        assert distance.min(1).max() < 1e-5
        assert len(set(distance.argmin(1))) == 200  # none twice
        shares.append(set(distance.argmin(1)))
    assert 100 < len(shares[0] & shares[1]) < 165  # 133 of 200 from 300 are expected
    assert max(shares[0]) > 250


@pytest.mark.parametrize("keep", [0.7, 0.501, 0.05, 1.0])
def test_a_half_space_keeps_exactly_its_share_on_one_side_of_a_plane(keep):
    points, direction = np.random.default_rng(0).normal(size=(1024, 3)), np.array([0.3, -2.0, 0.7])
    kept = keep_farthest_along(points, direction, keep)
    assert len(kept) == round(1024 * keep)
    height = points @ direction
    lowest = (kept @ direction).min()
    np.testing.assert_array_equal(kept, points[height >= lowest])
    pair = draw(DataConfig(points=100, crop="half-space", keep=keep))
    assert len(pair["source"]) == len(pair["target"]) == round(100 * keep)


def test_half_spaces_have_directions_uniform_on_the_sphere_one_for_each_cloud():
    ball = np.random.default_rng(0).normal(size=(2000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    ball = np.concatenate([ball, -ball])  # without a preferred direction
    directions = np.array([[c.mean(0) for c in crop(ball, ball, "half-space", 0.7, np.random.default_rng(i))] for i in range(400)])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    np.testing.assert_allclose(directions.mean(0), 0, atol=0.1)
    np.testing.assert_allclose(np.einsum("nci,ncj->cij", directions, directions) / 400, np.eye(3)[None].repeat(2, 0) / 3, atol=0.06)
    assert abs(np.mean(np.sum(directions[:, 0] * directions[:, 1], -1))) < 0.1  # the two cuts are independent


def test_half_spaces_overlap_as_independent_crops_do():
    shares = shared_share("half-space")
    assert shares.min() < 0.7
    assert shares.max() > 0.9


def test_noise_is_clipped_and_drawn_for_each_cloud():
    data = replace(CLEAN, noise_std=0.04, noise_clip=0.05)
    pair, clean = draw(data), draw(CLEAN)
    noise = [pair[name] - clean[name] for name in ("source", "target")]
    for cloud in noise:
        assert 0.049 < np.abs(cloud).max() < 0.05 + 1e-6
        np.testing.assert_allclose(cloud.mean(), 0, atol=0.01)
    assert not np.allclose(noise[0], noise[1])


def test_a_pair_is_a_function_of_seed_and_position_whatever_the_order():
    def pairs(seed):
        return Pairs(Objects(), np.array([5, 2, 7, 2]), config(DataConfig(points=100)), seed)

    forward = [pairs(1)[i] for i in range(4)]
    backward = {i: pairs(1)[i] for i in reversed(range(4))}
    again = list(pairs(1))
    for i, pair in enumerate(forward):
        for other in (backward[i], again[i], pairs(1)[i - 4]):
            assert all(np.array_equal(pair[name], other[name]) for name in pair)
    assert not np.array_equal(forward[1]["R"], forward[3]["R"])  # the same object at another position
    assert not np.array_equal(forward[0]["R"], pairs(2)[0]["R"])
    assert [pair["index"] for pair in forward] == [5, 2, 7, 2]
    for position in (4, -5):
        with pytest.raises(IndexError):
            pairs(1)[position]


def test_a_pair_does_not_depend_on_whether_views_are_attached():
    with_views, without = (Pairs(Objects(), np.arange(4), config(), 0, views=views)[2] for views in (True, False))
    assert set(with_views) - set(without) == {"views"}
    assert all(np.array_equal(without[name], with_views[name]) for name in without)


def test_views_of_the_object_are_its_own():
    pairs = Pairs(Objects(), np.array([4, 1]), config(), 0)
    for pair in pairs:
        assert pair["views"].shape == (1, 6, 16, 16)
        assert np.all(pair["views"] == pair["index"])


@pytest.mark.parametrize(("of", "sets"), [("source", 1), ("target", 1), ("both", 2)])
def test_views_of_what_was_observed_are_rendered_from_it(of, sets):
    pair = draw(CLEAN)
    views = observe(Objects(rendered=False), pair, replace(VIEWS, of=of))
    assert (views.shape, views.dtype) == ((sets, 6, 16, 16), np.dtype(np.uint8))
    assert views.any(axis=(2, 3)).all()
    both = observe(Objects(), pair, replace(VIEWS, of="both"))
    np.testing.assert_array_equal(views[0], both[{"source": 0, "target": 1, "both": 0}[of]])


def test_views_that_were_never_rendered_are_missed():
    with pytest.raises(ValueError, match=r"views\.of=object needs views rendered ahead of time"):
        observe(Objects(rendered=False), draw(CLEAN), VIEWS)


def shown(how, of="object", position=2, indices=(4, 1, 4, 7), views=True):
    pairs = Pairs(Objects(), np.array(indices), config(DataConfig(points=100), replace(VIEWS, of=of, shown=how)), 0, views)
    return pairs[position]


@pytest.mark.parametrize("of", ["object", "source", "both"])
def test_what_is_shown_changes_the_views_alone(of):
    real, shuffled, zero = (shown(how, of) for how in ("real", "shuffled", "zero"))
    for other in (shuffled, zero):
        assert all(np.array_equal(real[name], other[name]) for name in real if name != "views")
        assert (other["views"].shape, other["views"].dtype) == (real["views"].shape, np.dtype(np.uint8))
    assert not zero["views"].any()
    assert not np.array_equal(real["views"], shuffled["views"])
    assert shuffled["views"].any(axis=(2, 3)).all()
    np.testing.assert_array_equal(shuffled["views"], shown("shuffled", of)["views"])


def test_shuffled_views_are_of_any_other_object_of_the_list():
    seen = {int(shown("shuffled", position=p, indices=[4, 1, 4, 7] * 10)["views"][0, 0, 0, 0]) for p in range(0, 40, 2)}
    assert seen == {1, 7}
    with pytest.raises(ValueError, match=r"views\.shown=shuffled with object 4 alone"):
        shown("shuffled", position=0, indices=(4, 4))


def test_shuffled_views_of_both_clouds_are_of_one_other_pair():
    pair, rng = draw(DataConfig(points=100), seed=9), np.random.default_rng(9)
    pairs = Pairs(Objects(), np.array([3, 8]), config(DataConfig(points=100), replace(VIEWS, of="both", shown="shuffled")), 0)
    drawn = pairs.draw(0, rng)
    np.testing.assert_array_equal(drawn["source"], pair["source"])
    assert set(stack([drawn])) == {"source", "target", "R", "t", "views"}
    replay = np.random.default_rng(9)
    make_pair(Objects(), 3, DataConfig(points=100), replay)
    assert replay.choice(np.array([8])) == 8
    other = make_pair(Objects(), 8, DataConfig(points=100), replay)
    np.testing.assert_array_equal(drawn["views"], observe(Objects(), other, replace(VIEWS, of="both")))


def test_categories_filter_points_labels_and_views_together():
    objects = Objects()
    halves = {which: in_categories(objects.labels, objects.categories, which) for which in ("all", "first-half", "second-half")}
    np.testing.assert_array_equal(halves["all"], np.arange(12))
    np.testing.assert_array_equal(np.union1d(halves["first-half"], halves["second-half"]), np.arange(12))
    assert not set(halves["first-half"]) & set(halves["second-half"])
    for which, allowed in (("first-half", {0, 1, 2}), ("second-half", {3, 4, 5})):
        pairs = list(Pairs(objects, halves[which], config(), 0))
        assert {int(pair["label"]) for pair in pairs} == allowed
        for pair in pairs:
            np.testing.assert_array_equal(pair["object"], objects.points(int(pair["index"])))
            assert objects.labels[pair["index"]] == pair["label"]
            assert np.all(pair["views"] == pair["index"])


def test_forty_categories_split_at_twenty():
    labels, names = np.arange(40), [f"category {i}" for i in range(40)]
    np.testing.assert_array_equal(in_categories(labels, names, "first-half"), np.arange(20))
    np.testing.assert_array_equal(in_categories(labels, names, "second-half"), np.arange(20, 40))


def test_excluded_categories_are_left_out_and_the_halves_stay():
    labels = np.array([0, 1, 2, 3, 4, 5, 1, 4])
    assert in_categories(labels, "abcdef", "all", ("b", "e")).tolist() == [0, 2, 3, 5]
    assert in_categories(labels, "abcdef", "first-half", ("b", "e")).tolist() == [0, 2]
    assert in_categories(labels, "abcdef", "second-half", ("b", "e")).tolist() == [3, 5]
    assert in_categories(labels, "ab", "all", ("a", "b")).tolist() == [2, 3, 4, 5, 7]
    with pytest.raises(ValueError, match=r"data\.exclude: vase, z: expected names of categories, which are a, b, c"):
        in_categories(labels, "abc", "all", ("z", "a", "vase"))
    assert len(SYMMETRIC) == len(set(SYMMETRIC)) == 8


def test_a_limit_takes_evenly_spaced_pairs():
    assert evenly_spaced(5, None).tolist() == evenly_spaced(5, 9).tolist() == [0, 1, 2, 3, 4]
    assert evenly_spaced(9, 3).tolist() == [0, 4, 8]
    assert evenly_spaced(0, 3).tolist() == []
    with pytest.raises(ValueError, match="limit = 0: expected at least 1 pair"):
        evenly_spaced(5, 0)


@pytest.mark.parametrize(("share", "held"), [(0.1, 10), (0.001, 1), (0.999, 99)])
def test_the_validation_split_is_disjoint_complete_and_deterministic(share, held):
    indices = np.arange(1000, 1100)
    train, validation = split_validation(indices, share, seed=3)
    assert (len(train), len(validation)) == (100 - held, held)
    np.testing.assert_array_equal(np.sort(np.concatenate([train, validation])), indices)
    again = split_validation(indices, share, seed=3)
    np.testing.assert_array_equal(validation, again[1])
    assert not np.array_equal(validation, split_validation(indices, share, seed=4)[1])


def test_one_object_cannot_be_split():
    with pytest.raises(ValueError, match="at least 2 training objects, one of them for validation, got 1"):
        split_validation(np.array([5]), 0.1, 0)
