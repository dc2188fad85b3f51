"""Rigid transforms: a group that acts on points, over any batch axes, with NumPy and with JAX; which poses are valid."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.transform import RigidTransform, check_transform, stack, valid_transform


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=[(), (5,), (2, 3)], ids=str)
def axes(request):
    return request.param


@pytest.fixture(params=[np, jnp], ids=["NumPy", "JAX"])
def numpy(request):
    return request.param


def random_transform(seed, axes, numpy=np):
    rng = np.random.default_rng(seed)
    R = Rotation.random(int(np.prod(axes)), rng=rng).as_matrix().reshape(*axes, 3, 3)
    return RigidTransform(R=numpy.asarray(R), t=numpy.asarray(rng.normal(size=(*axes, 3))))


def assert_same(a, b):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-14), a, b)


def test_transforms_are_a_group(axes, numpy):
    a, b, c = (random_transform(seed, axes, numpy) for seed in range(3))
    identity = RigidTransform.identity(axes, jnp.float64)
    assert RigidTransform.identity(axes).R.dtype == jnp.float32
    assert a.get_batch_axes() == axes
    assert_same(a.compose(b).compose(c), a.compose(b.compose(c)))
    for found in (a.compose(identity), identity.compose(a), a.inverse().inverse()):
        assert_same(found, a)
    for found in (a.inverse().compose(a), a.compose(a.inverse())):
        assert_same(found, identity)


def test_the_group_acts_on_points(axes, numpy):
    a, b = (random_transform(seed, axes, numpy) for seed in range(2))
    points = numpy.asarray(np.random.default_rng(2).normal(size=(*axes, 7, 3)))
    assert_same(a.compose(b).apply(points), a.apply(b.apply(points)))
    assert_same(a.inverse().apply(a.apply(points)), points)
    assert_same(RigidTransform.identity(axes, jnp.float64).apply(points), points)
    expected = np.einsum("...ij,...nj->...ni", a.R, points) + np.asarray(a.t)[..., None, :]
    np.testing.assert_allclose(a.apply(points), expected, atol=1e-14)


def test_matrices_go_there_and_back(axes, numpy):
    a, b = (random_transform(seed, axes, numpy) for seed in range(2))
    matrix = a.as_matrix()
    assert matrix.shape == (*axes, 4, 4)
    for found in (RigidTransform.from_matrix(matrix), RigidTransform.from_matrix(matrix[..., :3, :])):
        jax.tree.map(np.testing.assert_array_equal, found, a)
    np.testing.assert_allclose(a.compose(b).as_matrix(), matrix @ b.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(a.inverse().as_matrix(), np.linalg.inv(matrix), atol=1e-14)


def test_numpy_gives_numpy_and_jax_gives_jax(axes, numpy):
    a, points = random_transform(0, axes, numpy), numpy.ones((*axes, 7, 3))
    results = [a.apply(points), a.inverse(), a.compose(a), a.as_matrix(), a.angle(), RigidTransform.from_matrix(a.as_matrix())]
    for x in jax.tree.leaves(results):
        assert isinstance(x, np.ndarray | np.floating if numpy is np else jax.Array)
        assert x.dtype == np.float64


def test_selecting_stacking_and_vmap():
    a, points = random_transform(0, (4,)), np.random.default_rng(1).normal(size=(4, 7, 3))
    assert_same(stack([a[i] for i in range(4)]), a)
    assert a[1:3].get_batch_axes() == (2,)
    np.testing.assert_allclose(jax.vmap(lambda pose, x: pose.apply(x))(a, points), a.apply(points), atol=1e-14)


def test_numpy_keeps_its_digits_where_jax_is_in_float32():
    with jax.enable_x64(False):
        R, offset = Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([5e6, 1e7, 0.123])
        a = RigidTransform(R=R, t=offset)
        points = np.random.default_rng(0).normal(size=(7, 3)) + offset
        np.testing.assert_allclose(a.apply(points), points @ R.T + offset, rtol=1e-15)
        np.testing.assert_allclose(a.inverse().apply(a.apply(points)), points, rtol=1e-14)
        np.testing.assert_allclose(a.inverse().compose(a).t, 0, atol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-4, 0.5, 2.0, 3.0, np.pi - 1e-3, np.pi])
def test_angle_of_a_known_rotation(angle, numpy):
    axis = np.array([0.6, -0.48, 0.64])
    turn, frame = Rotation.from_rotvec(angle * axis), Rotation.random(rng=np.random.default_rng(1))
    moved = RigidTransform(R=numpy.asarray((frame * turn).as_matrix()), t=numpy.zeros(3))
    still = RigidTransform(R=numpy.asarray(frame.as_matrix()), t=numpy.ones(3))
    atol = 1e-7 if angle > 3.1 else 1e-15  # the arc sine has half of the digits near pi
    for found in (still.inverse().compose(moved).angle(), moved.inverse().compose(still).angle()):
        np.testing.assert_allclose(found, angle, rtol=1e-6, atol=atol)
        assert 0 <= found <= np.pi


@pytest.mark.parametrize("angle", [1e-7, 1e-4])
def test_small_angles_keep_their_digits_in_float32(angle, numpy):
    R = Rotation.from_rotvec([0, 0, angle]).as_matrix().astype(np.float32)
    measured = RigidTransform(R=numpy.asarray(R), t=numpy.zeros(3, np.float32)).angle()
    assert measured.dtype == np.float32
    np.testing.assert_allclose(measured, angle, rtol=1e-5)


def test_rounding_of_bfloat16_is_accepted_and_removed(axes):
    exact = random_transform(0, axes)
    rounded = jax.tree.map(lambda x: jnp.asarray(x, jnp.bfloat16), exact)
    R = np.asarray(rounded.R, np.float64)
    assert np.abs(R @ R.swapaxes(-1, -2) - np.eye(3)).max() > 1e-4
    found = check_transform(rounded.R, rounded.t)
    assert {type(found.R), type(found.t)} == {np.ndarray}
    assert found.R.dtype == found.t.dtype == np.float64
    np.testing.assert_allclose(found.R @ found.R.swapaxes(-1, -2), np.broadcast_to(np.eye(3), found.R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(found.R), 1, atol=1e-14)
    np.testing.assert_allclose(found.R, exact.R, atol=1e-2)
    assert_same(check_transform(exact.R, exact.t), exact)


INVALID = {
    "NaN in R": (np.where(np.eye(3) > 0, np.nan, 0), np.zeros(3)),
    "infinite t": (np.eye(3), np.array([0, np.inf, 0])),
    "reflection": (np.diag([1.0, 1, -1]), np.zeros(3)),
    "scaled": (1.05 * np.eye(3), np.zeros(3)),
    "sheared": (np.eye(3) + 0.1 * np.eye(3, k=1), np.zeros(3)),
    "zero": (np.zeros((3, 3)), np.zeros(3)),
}


@pytest.mark.parametrize("kind", INVALID)
def test_an_invalid_pose_is_refused_with_its_name_and_value(kind):
    R, t = INVALID[kind]
    with pytest.raises(ValueError, match=r"^pose of cup 3: not a valid pose .*" + re.escape(f"R = {R.tolist()}, t = {t.tolist()}")):
        check_transform(R, t, "pose of cup 3")
    assert valid_transform(R, t) is None
    among_valid = random_transform(0, (4,))
    among_valid.R[2], among_valid.t[2] = R, t
    assert valid_transform(among_valid.R, among_valid.t) is None
    with pytest.raises(ValueError, match=r"^pose\[2\]: not a valid pose .*" + re.escape(f"R = {R.tolist()}, t = {t.tolist()}")):
        check_transform(among_valid.R, among_valid.t)


@pytest.mark.parametrize(("R", "t"), [((3, 4), (3,)), ((4, 4), (3,)), ((2, 3, 3), (3,)), ((3, 3), (1, 3)), ((3, 3), (4,)), ((3,), (3,))])
def test_other_shapes_are_refused_and_named(R, t):
    with pytest.raises(ValueError, match=r"^pose: R of shape " + re.escape(f"{R}, t of shape {t}; expected [..., 3, 3]")):
        check_transform(np.zeros(R), np.zeros(t))
