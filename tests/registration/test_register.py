"""Registering a user's clouds: any rotation, unit, order and kind of input, what disturbs clouds, and what cannot be registered."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax import RigidTransform, register
from cmig_jax.registration.search import rotations

UTM = np.array([500_000.0, 5_000_000.0, 100.0])


BOXES = [[0, 0, 0, 2, 1, 0.5], [0.7, 0.3, 0.7, 0.5, 0.4, 0.9], [-0.6, -0.35, 0.4, 0.5, 0.3, 0.3]]


def surface(count, seed, boxes=BOXES, shares=(0.6, 0.25, 0.15)):
    """Sample boxes (middle and size) on one another; `BOXES` has no symmetry, and is far from its mirror image."""
    rng = np.random.default_rng(seed)
    box = np.array(boxes)[rng.choice(len(boxes), count, p=shares)]
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = rng.choice([-0.5, 0.5], count)
    return box[:, :3] + points * box[:, 3:]


R = Rotation.from_euler("zyx", [50, -70, 100], degrees=True).as_matrix()
T = np.array([3.0, -2.0, 1.0])
SOURCE, TARGET = surface(700, 0), surface(600, 1) @ R.T + T


@pytest.fixture(scope="module")
def found():
    return register(SOURCE, TARGET)


def is_right(found, R=R, source=SOURCE, unit: float = 1.0, offset: float | np.ndarray = 0.0):
    """Whether the pose takes `unit * source + offset` to where the body is, to 3 degrees and 0.03 of its middle."""
    angle = np.degrees(RigidTransform(R=found.matrix[:3, :3] @ R.T, t=np.zeros(3)).angle())
    away = (found.apply(unit * source + offset) - offset) / unit - (source @ R.T + T)
    return angle < 3 and np.linalg.norm(away.mean(axis=0)) < 0.03


@pytest.mark.parametrize("angle", [0, 45, 90, 135, 180])
@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_any_rotation_is_found(axis, angle):
    turned = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
    found = register(SOURCE, surface(600, 1) @ turned.T + T)
    assert is_right(found, turned)
    assert found.trusted


def test_the_result_says_what_speaks_for_it(found):
    assert is_right(found)
    assert (found.trusted, found.why) == (True, "aligned")
    assert min(found.overlap) > 0.85
    assert 0 < found.inlier_rmse < 0.1
    source, target = found.correspondences.T
    distances = np.linalg.norm(found.apply(SOURCE[source]) - TARGET[target], axis=1)
    assert len(source) > 200
    assert np.median(distances) < 0.1
    assert np.linalg.eigvalsh(found.information).min() > 0
    assert found.dropped == (0, 0)
    assert set(found.seconds) == {"clouds", "network", "search", "choice", "refinement"}
    printed = str(found)
    assert printed.startswith("trusted (confidence ")
    assert f"{found.matrix[0, 0]:.8g}" in printed


def test_the_result_depends_neither_on_the_order_of_rows_nor_on_chance(found):
    rng = np.random.default_rng(2)
    for source, target in ((SOURCE, TARGET), (rng.permutation(SOURCE), rng.permutation(TARGET))):
        np.testing.assert_array_equal(register(source, target).matrix, found.matrix)


def test_clouds_that_share_their_points_are_aligned_precisely():
    np.testing.assert_allclose(register(SOURCE, SOURCE @ R.T + T).apply(SOURCE), SOURCE @ R.T + T, atol=1e-6)
    np.testing.assert_allclose(register(SOURCE, SOURCE[:500] @ R.T + T).apply(SOURCE), SOURCE @ R.T + T, atol=1e-3)


def test_the_clouds_are_left_alone(found):
    np.testing.assert_array_equal(SOURCE, surface(700, 0))


@pytest.mark.parametrize("unit", [2.0**-10, 1000.0])
def test_another_unit_scales_the_translation_alone(found, unit):
    scaled = register(SOURCE * unit, TARGET * unit)
    np.testing.assert_allclose(scaled.matrix[:3, :3], found.matrix[:3, :3], atol=1e-3)
    np.testing.assert_allclose(scaled.matrix[:3, 3] / unit, found.matrix[:3, 3], atol=2e-3)
    assert scaled.inlier_rmse == pytest.approx(unit * found.inlier_rmse, rel=0.05)


def test_clouds_far_from_the_origin_and_whole_millimetres(found):
    assert is_right(register(SOURCE + UTM, TARGET + UTM), offset=UTM)
    assert is_right(register((1000 * SOURCE).astype(np.int32), (1000 * TARGET).astype(np.int32)), unit=1000.0)


def test_single_precision_that_has_lost_the_shape_is_named():
    with pytest.raises(ValueError, match=r"source: float32 resolves 0.6 at coordinates around 5e\+06.*expected float64"):
        register((SOURCE + UTM).astype(np.float32), TARGET + UTM)


def patch(cloud, share):
    """Return the share of a cloud that is nearest to one of its points."""
    distance = np.linalg.norm(cloud - cloud[0], axis=1)
    return cloud[distance <= np.quantile(distance, share)]


OUTLIERS = np.random.default_rng(4).uniform(-1, 1, (2, 1_000, 3))
DISTURBED = {
    "one stray point": (np.r_[SOURCE, [[200.0, 0, 0]]], TARGET),
    "a stray point in the target": (SOURCE, np.r_[TARGET, [[0, 0, -200.0]]]),
    "each point 25 times": (np.repeat(SOURCE, 25, axis=0), np.repeat(TARGET, 25, axis=0)),
    "half of the points at zero": (np.r_[SOURCE, np.zeros((700, 3))], np.r_[TARGET, np.zeros((600, 3))]),
    "outliers, a fifth": (np.r_[SOURCE, np.random.default_rng(3).uniform(-1, 1, (140, 3))], TARGET),
    "outliers, as many as points": (np.r_[surface(1_000, 0), OUTLIERS[0]], np.r_[surface(1_000, 1) @ R.T, OUTLIERS[1]] + T),
    "densities of 1,000 to 1": (SOURCE[:300], surface(300_000, 1) @ R.T + T),
    "a patch of 30 %": (patch(surface(3_000, 0), 0.3), surface(3_000, 1) @ R.T + T),
}


@pytest.mark.parametrize("name", DISTURBED)
def test_what_disturbs_clouds_changes_nothing(name):
    assert is_right(register(*DISTURBED[name]))


@pytest.mark.parametrize("kind", ["float16", "lists", "points", "vertices", "torch"])
def test_clouds_may_be_of_many_kinds(kind):
    if kind == "torch":
        torch = pytest.importorskip("torch")
        clouds = torch.tensor(SOURCE, requires_grad=True), torch.tensor(TARGET, dtype=torch.bfloat16)
    elif kind == "lists":
        clouds = SOURCE.tolist(), TARGET.tolist()
    elif kind == "float16":
        clouds = SOURCE.astype(np.float16), TARGET.astype(np.float16)
    else:
        clouds = SimpleNamespace(**{kind: SOURCE.tolist()}), SimpleNamespace(**{kind: TARGET})
    assert is_right(register(*clouds))


def test_rows_that_are_not_finite_are_dropped_and_counted_if_asked():
    source = np.r_[SOURCE, np.full((5, 3), np.nan)][::-1]
    found = register(source, TARGET, invalid="drop")
    assert is_right(found)
    assert found.dropped == (5, 0)
    near = np.linalg.norm(found.apply(source[found.correspondences[:, 0]]) - TARGET[found.correspondences[:, 1]], axis=1)
    assert np.isfinite(near).all(), "correspondences count the rows that were given"
    with pytest.raises(ValueError, match="source: point 0 is"):
        register(source, TARGET)


def test_a_start_and_a_bound_on_the_rotation_are_kept_to():
    near = RigidTransform(R=Rotation.from_euler("x", 12, degrees=True).as_matrix() @ R, t=T + 0.1)
    assert is_right(register(SOURCE, TARGET, init=near))
    angle = np.degrees(Rotation.from_matrix(R).magnitude())
    assert angle > 90
    limited = register(SOURCE, TARGET, rotations=30)
    assert np.degrees(limited.target_from_source.angle()) < 40
    for wrong in (-1, 181, "all"):
        with pytest.raises(ValueError, match=f"rotations = {wrong!r}: expected any, yaw, or an angle of 0 to 180"):
            register(SOURCE, TARGET, rotations=wrong)  # pyright: ignore[reportArgumentType]


def test_a_bound_of_0_leaves_the_translation():
    found = register(SOURCE, surface(600, 1) + T, rotations=0)
    assert is_right(found, np.eye(3))
    assert found.trusted


def test_a_bound_beside_a_start_does_not_lower_the_confidence():
    near = RigidTransform(Rotation.from_euler("x", 5, degrees=True).as_matrix() @ R, T)
    free, bounded = register(SOURCE, TARGET, init=near), register(SOURCE, TARGET, init=near, rotations=25)
    assert is_right(bounded)
    assert bounded.confidence == free.confidence


def test_the_reason_for_a_cloud_of_another_unit_is_the_sizes():
    for unit in (0.001, 1_000):
        assert "their sizes differ" in register(unit * SOURCE, TARGET).why


def test_rotations_are_spread_evenly():
    """Every rotation has one within 32 degrees among those that are tried."""
    tried, asked = Rotation.from_matrix(np.array(rotations(180))), Rotation.from_quat(np.random.default_rng(0).normal(size=(300, 4)))
    nearest = [np.degrees((one.inv() * tried).magnitude().min()) for one in asked]
    assert max(nearest) < 32
    assert len(rotations(0)) == 1
    assert all(np.degrees(Rotation.from_matrix(turn).magnitude()) <= 40 for turn in rotations(40))


OTHER = np.random.default_rng(5).normal(size=(600, 3))
UNTRUSTED = {
    "another body": (SOURCE, OTHER / np.linalg.norm(OTHER, axis=1, keepdims=True)),
    "a mirrored copy": (SOURCE * [-1, 1, 1], TARGET),
    "half the size": (0.5 * SOURCE, TARGET),
    "1.25 times the size": (1.25 * SOURCE, TARGET),
    "two ends of one body": (SOURCE[SOURCE[:, 0] < -0.4], TARGET[surface(600, 1)[:, 0] > 0.4]),
    "a thousandth of the size": (0.001 * SOURCE, TARGET),
}


def test_a_mirrored_copy_of_a_nearly_symmetric_body_is_not_trusted():
    low = [[0, 0, 0, 2, 1, 0.5], [0.7, 0.1, 0.5, 0.5, 0.4, 0.9], [-0.6, -0.3, 0.4, 0.3, 0.2, 0.3]]
    body, again = (surface(count, seed, low, (0.6, 0.3, 0.1)) for count, seed in ((700, 0), (600, 1)))
    assert not register(body * [-1, 1, 1], again @ R.T + T).trusted


@pytest.mark.parametrize("name", UNTRUSTED)
def test_clouds_that_do_not_belong_together_are_not_trusted(name):
    found = register(*UNTRUSTED[name])
    assert not found.trusted
    assert found.why != "aligned"
    assert str(found).startswith("NOT trusted")


def test_a_body_of_revolution_has_alternatives():
    rng = np.random.default_rng(7)
    angle, height = rng.uniform(0, 2 * np.pi, 800), rng.uniform(-1, 1, 800)
    tube = np.stack([np.cos(angle), np.sin(angle), height], axis=1)
    found = register(tube[:400], tube[400:])
    assert 1 <= len(found.alternatives) <= 8
    assert "symmetric" in found.why
    assert not found.trusted


def line(points):
    return np.linspace([0, 0, 0], [1, 2, 3], points) + 7


def with_value(value):
    cloud = np.random.default_rng(1).normal(size=(40, 3))
    cloud[5, 2] = value
    return cloud


BAD = {
    "empty": (np.zeros((0, 3)), "0 different points; expected at least 10"),
    "no points at all": ([], r"shape \(0,\), float64; expected \[N, 3\] real numbers"),
    "one point": (np.ones((1, 3)), "1 different points; expected at least 10"),
    "too few points": (np.random.default_rng(0).normal(size=(9, 3)), "9 different points; expected at least 10 .*Rotation.align_vectors"),
    "too few different points": (np.repeat(np.random.default_rng(0).normal(size=(5, 3)), 9, axis=0), "5 different points; expected at"),
    "colours behind": (np.ones((40, 6)), r"expected \[N, 3\] real numbers: pass cloud\[:, :3\]"),
    "columns": (np.ones((3, 40)), "real numbers: pass cloud.T"),
    "a structured array": (np.zeros(40, [("x", "f4"), ("y", "f4"), ("z", "f4")]), r"real numbers: pass np.stack\(\[cloud\["),
    "an image": (np.ones((8, 5, 3)), r"real numbers: pass cloud.reshape\(-1, 3\)"),
    "nan": (with_value(np.nan), r"point 5 is .*nan\]; expected finite coordinates \(1 of 40 points"),
    "infinite": (with_value(np.inf), r"point 5 is .*inf\]; expected finite"),
    "two coordinates": (np.ones((40, 2)), r"shape \(40, 2\), float64; expected \[N, 3\]"),
    "a batch": (np.ones((1, 40, 3)), r"shape \(1, 40, 3\), float64; expected \[N, 3\]"),
    "ragged": ([[1.0, 2.0, 3.0], [1.0, 2.0]], r"expected \[N, 3\] numbers"),
    "strings": (np.full((40, 3), "a"), r"shape \(40, 3\), <U1; expected \[N, 3\] real numbers"),
    "strings of digits": (np.full((40, 3), "1"), r"shape \(40, 3\), <U1; expected \[N, 3\] real numbers"),
    "complex": (np.full((40, 3), 1j), r"complex128; expected \[N, 3\] real numbers"),
    "none": (None, "expected"),
    "all points equal": (np.full((40, 3), 2.5), "1 different points"),
    "collinear": (line(40), "all points are equal or on one line"),
    "collinear in single precision": (line(40).astype(np.float32), "all points are equal or on one line"),
}


@pytest.mark.parametrize("name", BAD)
@pytest.mark.parametrize("which", ["source", "target"])
def test_a_bad_cloud_is_refused_by_its_name_and_value(name, which):
    cloud, message = BAD[name]
    clouds = {"source": SOURCE, "target": TARGET} | {which: cloud}
    with pytest.raises(ValueError, match=f"{which}.*{message}"):
        register(clouds["source"], clouds["target"])


def test_masked_points_are_refused():
    hidden = np.ma.masked_array(SOURCE, np.arange(len(SOURCE))[:, None] % [9, 9, 9] == 0)
    with pytest.raises(ValueError, match="source: 234 masked values; expected none"):
        register(hidden, TARGET)


def test_a_plane_registers():
    grid = np.stack(np.meshgrid(np.arange(9), np.arange(7), [5]), axis=-1).reshape(-1, 3)
    assert np.linalg.det(register(grid, grid).matrix) == pytest.approx(1)
