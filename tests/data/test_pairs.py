"""Pairs of objects: what each is a function of, and its views."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.config import DataConfig, ViewsConfig
from cmig_jax.data.loader import stack
from cmig_jax.data.normals import observed_normals
from cmig_jax.data.pairs import Pairs, evenly_spaced, in_categories, make_pair, observe, render_clouds

DATA = DataConfig(points=100)
VIEWS = ViewsConfig(count=6, size=16, layout="axes")
BOTH = replace(VIEWS, of="both")


@dataclasses.dataclass
class Objects:
    """Random clouds in the unit sphere, 300 points each, of 6 categories; points and name depend on the object's number alone."""

    numbers: tuple[int, ...] = tuple(range(12))
    categories: tuple[str, ...] = tuple("abcdef")
    rendered: bool = True

    @property
    def labels(self):
        return np.array(self.numbers, np.int32) % 6

    @property
    def names(self):
        return [f"thing-{number}" for number in self.numbers]

    def points(self, i):
        cloud = np.random.default_rng(self.numbers[i]).normal(size=(300, 3))
        return (cloud / np.linalg.norm(cloud, axis=1).max()).astype(np.float32)

    def views(self, i):
        return np.full((6, 16, 16), self.numbers[i], np.uint8) if self.rendered else None


def assert_same(one, other, names=None):
    for name in names or other:
        np.testing.assert_array_equal(one[name], other[name])


def by_name(objects, indices, views):
    pairs = Pairs(objects, np.asarray(indices), DATA, views, 0)
    return dict(zip(pairs.names, pairs, strict=True))


@pytest.mark.parametrize(("pose_of", "poses"), [("each-pair", 6), ("each-object", 2)])
def test_an_object_keeps_its_pose_or_has_one_for_each_pair(pose_of, poses):
    pairs = Pairs(Objects(), np.arange(2), replace(DATA, pose_of=pose_of), None, 0)
    drawn = [pairs.draw(position, np.random.default_rng([position, epoch])) for position in (0, 1) for epoch in range(3)]
    assert len({pair["R"].tobytes() for pair in drawn}) == len({pair["t"].tobytes() for pair in drawn}) == poses
    assert len({pair["source"].tobytes() for pair in drawn}) == 6


def test_the_pose_of_an_object_is_not_drawn_by_the_numbers_that_draw_its_validation_pair():
    each = [Pairs(Objects(), np.arange(12), replace(DATA, pose_of=of), None, DATA.test_seed) for of in ("each-object", "each-pair")]
    kept, drawn = (np.array([pair["R"] for pair in pairs]) for pairs in each)
    assert np.abs(kept - drawn).max(axis=(1, 2)).min() > 0.01


@pytest.mark.parametrize("views", [None, VIEWS, BOTH, replace(BOTH, shown="shuffled")])
def test_a_pair_is_a_function_of_seed_and_object_whichever_other_objects_there_are(views):
    objects = Objects()
    everything = by_name(objects, np.arange(12), views)
    excluded = in_categories(objects.labels, objects.categories, "all", ("b", "d"))
    for indices in (np.arange(12)[::-1], evenly_spaced(12, 5), excluded, [7], [3, 9, 3]):
        some = by_name(objects, indices, views)
        assert set(some) == {f"thing-{i}" for i in indices}
        for name, pair in some.items():
            assert_same(pair, everything[name])
    for numbers in ((*range(20),), (11, 3, 8), (4,)) if views is not None and views.shown == "real" else ():
        some = by_name(Objects(numbers), np.arange(len(numbers)), views)
        for name in set(some) & set(everything):
            assert_same(some[name], everything[name], set(everything[name]) - {"index"})


def test_pairs_of_other_seeds_and_objects_differ():
    pairs = Pairs(Objects(), np.array([5, 2, 7, 2]), DATA, None, 1)
    assert [pair["index"] for pair in pairs] == [5, 2, 7, 2]
    assert [pair["label"] for pair in pairs] == [5, 2, 1, 2]
    assert pairs.names == ["thing-5", "thing-2", "thing-7", "thing-2"]
    assert_same(pairs[1], pairs[-3])
    assert len(np.unique([pairs[i]["R"] for i in range(4)], axis=0)) == 3
    assert not np.array_equal(pairs[0]["R"], Pairs(Objects(), np.array([5]), DATA, None, 2)[0]["R"])
    for position in (4, -5):
        with pytest.raises(IndexError):
            pairs[position]


PINNED = {
    "shared": ([-0.53813, -0.0845, 0.33465], [0.07484, -0.268, 0.27869], (64.12, 78.91)),
    "independent": ([-0.53813, -0.0845, 0.33465], [0.78344, 0.04619, 0.19528], (64.12, 62.04)),
    "none": ([-0.1134, 0.05917, 0.49153], [0.07484, -0.268, 0.27869], (68.57, 67.07)),
    "twice": ([-0.53813, -0.0845, 0.33465], [0.33436, 0.20428, 0.29237], (64.12, 52.96)),
}


@pytest.mark.parametrize("protocol", PINNED)
def test_the_numbers_of_a_pair_stay_those_of_earlier_versions(protocol):
    flags = {"sampling": "twice"} if protocol == "twice" else {"crop": protocol}
    pairs = Pairs(Objects(), np.array([5, 2, 7]), replace(DATA, **flags), BOTH, 1234)
    pair = pairs.draw(1, np.random.default_rng([1234, 1]))
    source, target, greys = PINNED[protocol]
    np.testing.assert_allclose(pair["source"][-1], source, atol=2e-5)
    np.testing.assert_allclose(pair["target"][-1], target, atol=2e-5)
    np.testing.assert_allclose(pair["R"][2], [-0.30191, 0.12848, 0.94464], atol=2e-5)
    np.testing.assert_allclose(pair["t"], [0.39281, 0.21245, 0.31663], atol=2e-5)
    np.testing.assert_allclose(pair["views"].mean(axis=(1, 2, 3)), greys, atol=0.5)
    np.testing.assert_allclose(pairs[1]["t"], [0.24388, 0.33287, 0.20134], atol=2e-5)  # seeded by the object's name


def test_a_frame_turns_a_pair_as_a_whole():
    plain, turned = (make_pair(Objects(), 3, replace(DATA, frame=frame), np.random.default_rng(0)) for frame in ("object", "any"))
    Q, _ = Rotation.align_vectors(turned["object"], plain["object"])
    assert Q.magnitude() > 0.1
    for part in ("source", "target", "object", "t"):
        np.testing.assert_allclose(turned[part], Q.apply(plain[part]), atol=1e-6)
    np.testing.assert_allclose(turned["R"], Q.as_matrix() @ plain["R"] @ Q.as_matrix().T, atol=1e-6)
    assert {part: value.dtype for part, value in turned.items()} == {part: value.dtype for part, value in plain.items()}
    normals = make_pair(Objects(), 3, replace(DATA, frame="any", normals="observed"), np.random.default_rng(0), normals=True)
    near = observed_normals(turned["source"])
    np.testing.assert_allclose(np.abs(np.sum(normals["source_normals"] * near, axis=1)), 1, atol=1e-4)


def test_half_of_the_training_pairs_are_turned():
    pairs = [Pairs(Objects(), np.array([3]), replace(DATA, frame=frame), None, 0) for frame in ("object", "half", "any")]
    of = [[pair.draw(0, np.random.default_rng(i))["R"] for i in range(200)] for pair in pairs]
    assert 70 < sum(np.array_equal(R, plain) for R, plain in zip(of[1], of[0], strict=True)) < 130
    assert not any(np.array_equal(R, plain) for R, plain in zip(of[2], of[0], strict=True))


def test_an_object_of_too_few_points_is_named():
    with pytest.raises(ValueError, match="object thing-3 has 300 points: expected at least 301"):
        make_pair(Objects(), 3, replace(DATA, points=301), np.random.default_rng(0))


@pytest.mark.parametrize(("of", "sets"), [("source", 1), ("target", 1), ("both", 2)])
def test_views_of_observed_clouds_are_rendered_from_them(of, sets):
    pair = make_pair(Objects(), 3, DATA, np.random.default_rng(0))
    views = observe(Objects(rendered=False), pair, replace(VIEWS, of=of))
    assert (views.shape, views.dtype) == ((sets, 6, 16, 16), np.dtype(np.uint8))
    assert views.any(axis=(2, 3)).all()
    both = observe(Objects(), pair, BOTH)
    np.testing.assert_array_equal(views[0], both[{"source": 0, "target": 1, "both": 0}[of]])


def test_views_of_the_object_are_its_own_and_rendered_ahead_of_time():
    for pair in Pairs(Objects(), np.array([4, 1]), DATA, VIEWS, 0):
        assert pair["views"].shape == (1, 6, 16, 16)
        assert np.all(pair["views"] == pair["index"])
        np.testing.assert_array_equal(pair["object"], Objects().points(pair["index"]))
    with pytest.raises(ValueError, match=r"views\.of=object needs views rendered ahead of time"):
        Pairs(Objects(rendered=False), np.array([4]), DATA, VIEWS, 0)[0]
    with pytest.raises(ValueError, match=r"views\.of=object: two partial clouds do not show"):
        render_clouds({}, VIEWS)


@pytest.mark.parametrize("of", ["object", "source", "both"])
def test_what_is_shown_changes_the_views_alone(of):
    real, shuffled, zero = (
        Pairs(Objects(), np.array([4, 1, 7]), DATA, replace(VIEWS, of=of, shown=shown), 0)[2] for shown in ("real", "shuffled", "zero")
    )
    for other in (shuffled, zero):
        assert_same(other, real, set(real) - {"views"})
        assert (other["views"].shape, other["views"].dtype) == (real["views"].shape, np.dtype(np.uint8))
    assert not zero["views"].any()
    assert not np.array_equal(real["views"], shuffled["views"])
    assert shuffled["views"].any(axis=(2, 3)).all()


def test_shuffled_views_are_of_any_other_object_of_the_split():
    pairs = [Pairs(Objects((4, 1, 7)), np.array([0]), DATA, replace(VIEWS, shown="shuffled"), seed)[0] for seed in range(20)]
    assert {int(pair["views"][0, 0, 0, 0]) for pair in pairs} == {1, 7}
    with pytest.raises(ValueError, match=r"views\.shown=shuffled with object 0 alone"):
        Pairs(Objects((4,)), np.array([0]), DATA, replace(VIEWS, shown="shuffled"), 0)[0]


def test_shuffled_views_of_both_clouds_are_of_one_other_pair():
    objects = Objects((3, 8))
    drawn = Pairs(objects, np.array([0, 1]), DATA, replace(BOTH, shown="shuffled"), 0).draw(0, np.random.default_rng(9))
    assert set(stack([drawn])) == {"source", "target", "R", "t", "views"}
    replay = np.random.default_rng(9)
    assert_same(drawn, make_pair(objects, 0, DATA, replay))
    assert replay.choice(np.array([1])) == 1
    np.testing.assert_array_equal(drawn["views"], observe(objects, make_pair(objects, 1, DATA, replay), BOTH))
