"""Which objects pairs are made of: categories, a limit, and the validation split."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.data.pairs import evenly_spaced, in_categories, seeded, split_validation
from cmig_jax.data.protocol import SYMMETRIC, random_pose

NAMES = [f"category {i % 10}/object {i}" for i in range(400)]


def test_the_halves_of_the_categories_split_the_objects():
    labels, names = np.arange(12) % 6, "abcdef"
    halves = {which: in_categories(labels, names, which) for which in ("all", "first-half", "second-half")}
    np.testing.assert_array_equal(halves["all"], np.arange(12))
    np.testing.assert_array_equal(np.sort(np.concatenate([halves["first-half"], halves["second-half"]])), np.arange(12))
    assert set(labels[halves["first-half"]]) == {0, 1, 2}
    assert set(labels[halves["second-half"]]) == {3, 4, 5}
    forty = np.arange(40)
    np.testing.assert_array_equal(in_categories(forty, [f"category {i}" for i in forty], "second-half"), np.arange(20, 40))


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
    assert all(len(evenly_spaced(count, limit)) == limit for count in range(1, 60) for limit in range(1, count + 1))
    with pytest.raises(ValueError, match="limit = 0: expected at least 1 pair"):
        evenly_spaced(5, 0)


@pytest.mark.parametrize(("share", "held"), [(0.1, 10), (0.001, 1), (0.999, 99)])
def test_the_validation_split_is_disjoint_complete_and_deterministic(share, held):
    indices = np.arange(300, 400)
    train, validation = split_validation(indices, NAMES, share, seed=3)
    assert (len(train), len(validation)) == (100 - held, held)
    np.testing.assert_array_equal(np.sort(np.concatenate([train, validation])), indices)
    np.testing.assert_array_equal(validation, split_validation(indices[::-1], NAMES, share, seed=3)[1])
    assert not np.array_equal(validation, split_validation(indices, NAMES, share, seed=4)[1])


@pytest.mark.parametrize("left_out", range(10))
def test_leaving_out_a_category_hardly_changes_who_is_held_out(left_out):
    everything = np.arange(400)
    kept = everything[everything % 10 != left_out]
    held, held_of_kept = (set(split_validation(indices, NAMES, 0.1, seed=3)[1]) for indices in (everything, kept))
    assert len(held_of_kept) == 36
    changed = (held & set(kept)) ^ held_of_kept
    assert len(changed) == abs(36 - len(held & set(kept))) <= 5, "only objects at the border change, all in the same direction"


def test_the_split_does_not_depend_on_the_numbers_of_the_objects():
    order = np.random.default_rng(0).permutation(400)
    held = {NAMES[i] for i in split_validation(np.arange(400), NAMES, 0.1, seed=3)[1]}
    names = [NAMES[i] for i in order]
    assert {names[i] for i in split_validation(np.arange(400), names, 0.1, seed=3)[1]} == held


def test_the_split_tells_nothing_about_the_pairs():
    """Split and validation pairs have the same seed; the first number drawn for a pair is its angle about x."""
    _, held = split_validation(np.arange(400), NAMES, 0.2, seed=1234)
    R = np.stack([random_pose(seeded(1234, NAMES[i]), 45.0, 0.5)[0] for i in held])
    angles = Rotation.from_matrix(R).as_euler("XYZ", degrees=True)
    np.testing.assert_allclose(angles.mean(0), 22.5, atol=4)
    assert angles.max(0).min() > 40


def test_one_object_cannot_be_split():
    with pytest.raises(ValueError, match="at least 2 training objects, one of them for validation, got 1"):
        split_validation(np.array([5]), NAMES, 0.1, 0)
