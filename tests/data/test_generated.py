"""Generated objects: 40 categories of closed, outward-facing parts, each a function of its generator alone."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from cmig_jax.data import solids
from cmig_jax.data.generated import CATEGORIES, make_object


def _make(label: int, seed: int) -> trimesh.Trimesh:
    return make_object(label, np.random.default_rng([seed, label]))


def test_forty_categories_by_name():
    assert len(CATEGORIES) == len(set(CATEGORIES)) == 40
    assert all(name.isidentifier() and name.islower() for name in CATEGORIES)


@pytest.mark.parametrize("label", range(40), ids=CATEGORIES)
def test_every_part_is_closed_and_faces_outwards(label):
    for seed in range(6):
        mesh = _make(label, seed)
        assert np.isfinite(mesh.vertices).all()
        assert mesh.area_faces.min() > 0
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert _smallest_part_volume(mesh) > 0


def _smallest_part_volume(mesh: trimesh.Trimesh) -> float:
    # Parts share no vertex and are stored one after the other: one ends where no later face uses an earlier vertex.
    starts = _part_starts(mesh.faces.min(1), mesh.faces.max(1))
    centre = mesh.vertices.mean(0)
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - centre for i in range(3))
    return np.add.reduceat((a * np.cross(b, c)).sum(-1), starts).min()


def _part_starts(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    before = np.concatenate([[-1], np.maximum.accumulate(high)[:-1]])
    after = np.minimum.accumulate(low[::-1])[::-1]
    return np.flatnonzero(after > before)


@pytest.mark.parametrize("label", range(40), ids=CATEGORIES)
def test_an_object_is_a_function_of_its_generator(label):
    one, same, other = _make(label, 1), _make(label, 1), _make(label, 2)
    np.testing.assert_array_equal(one.vertices, same.vertices)
    np.testing.assert_array_equal(one.faces, same.faces)
    assert one.vertices.shape != other.vertices.shape or not np.allclose(one.vertices, other.vertices)


def _misfit(label: int, seed: int, turn_deg: float) -> float:
    """How much farther than unturned the surface lies from itself after a turn about z, in radii, on the mean."""
    points = trimesh.sample.sample_surface(_make(label, seed), 4000, seed=seed)[0]
    points = points - points.mean(0)
    points /= np.linalg.norm(points, axis=-1).max()
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    tree, half = cKDTree(points[:2000]), points[2000:]
    turned = half @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]).T
    return float(tree.query(turned)[0].mean() - tree.query(half)[0].mean())


@pytest.mark.parametrize("label", range(40), ids=CATEGORIES)
def test_no_category_is_a_solid_of_revolution(label):
    gaps = [_misfit(label, seed, turn) for seed in range(2) for turn in (70, 130)]
    assert np.mean(gaps) > 0.01


@pytest.mark.parametrize("label", [-1, 40])
def test_an_unknown_label_is_an_error(label):
    with pytest.raises(ValueError, match=f"label = {label}: expected 0 to 39"):
        make_object(label, np.random.default_rng(0))


def _volume(solid: solids.Solid) -> float:
    a, b, c = (solid.vertices[solid.faces[:, i]] for i in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("solid", "volume"),
    [
        (solids.box(1, 2, 3), 6.0),
        (solids.box(2, 2, 3, top=0.5), 7.0),
        (solids.cylinder(1, 2, sections=200), 2 * np.pi),
        (solids.lathe([(1, 0), (0, 3)], 200), np.pi),
        (solids.lathe([(0, 3), (1, 0)], 200), np.pi),
        (solids.rod((0, 0, 0), (1, 2, 2), 0.5, sections=200), 0.75 * np.pi),
        (solids.ring(2, 0.5, sections=60), 2 * np.pi**2 * 2 * 0.25),
        (solids.plate([(0, 0), (3, 0), (0, 4)], 2), 12.0),
        (solids.panel([(0, 0), (3, 0), (0, 4)], 2), 12.0),
        (solids.vessel([(1, 0), (1, 1)], 0.5, 200), np.pi * (1 - 0.25 * 0.5)),
        (solids.box(1, 2, 3).turned("x", 33).turned("y", 50).turned("z", 71).at(3, 4, 5), 6.0),
    ],
)
def test_solids_enclose_their_volume(solid, volume):
    assert _volume(solid) == pytest.approx(volume, rel=0.02)


def test_a_turn_is_right_handed():
    moved = [solids.Solid(np.eye(3), np.zeros((0, 3), int)).turned(axis, 90).vertices for axis in ("x", "y", "z")]
    np.testing.assert_allclose(moved[0], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(moved[1], [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(moved[2], [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_a_curve_starts_and_ends_at_its_controls():
    path = solids.curve([(0, 0, 0), (5, 5, 5), (1, 2, 3)], 7)
    assert path.shape == (7, 3)
    np.testing.assert_allclose(path[[0, -1]], [(0, 0, 0), (1, 2, 3)])
