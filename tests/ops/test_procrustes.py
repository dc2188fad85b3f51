"""The pose solver is exact, optimal, never a reflection, and differentiable wherever the pose is defined."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cmig_jax.ops.procrustes import project_to_rotation, weighted_procrustes

solve = jax.jit(weighted_procrustes, static_argnums=3)
project = jax.jit(project_to_rotation)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def problem(seed=0, B=4, K=12):
    """Draw clouds, true poses and weights that sum to 1."""
    rng = np.random.default_rng(seed)
    source, weight = rng.normal(size=(B, K, 3)), rng.uniform(0.1, 1, (B, K))
    R, t = Rotation.random(B, rng=rng).as_matrix(), rng.normal(size=(B, 3))
    return source, source @ R.swapaxes(1, 2) + t[:, None], weight / weight.sum(1, keepdims=True), R, t


def residual(R, t, source, target, weight):
    return np.sum(weight * np.sum((source @ np.swapaxes(R, -1, -2) + t[..., None, :] - target) ** 2, -1), -1)


def assert_rotation(R):
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-12)


@pytest.mark.parametrize("centroid", ["weighted", "unweighted"])
def test_exact_correspondences_give_the_exact_pose(centroid):
    source, target, weight, R, t = problem()
    pose = solve(source, target, weight, centroid)
    assert pose.R.dtype == pose.t.dtype == jnp.float64
    np.testing.assert_allclose(pose.R, R, atol=1e-12)
    np.testing.assert_allclose(pose.t, t, atol=1e-12)


def test_points_of_zero_weight_do_not_count():
    source, target, weight, R, t = problem()
    weight[:, 5:9] = 0
    weight /= weight.sum(1, keepdims=True)
    target[:, 5:9] += 100 * np.random.default_rng(1).normal(size=(4, 4, 3))
    pose = solve(source, target, weight, "weighted")
    np.testing.assert_allclose(pose.R, R, atol=1e-12)
    np.testing.assert_allclose(pose.t, t, atol=1e-12)


def test_weighted_centroids_minimise_the_weighted_residual():
    source, target, weight, *_ = problem()
    target += 0.3 * np.random.default_rng(2).normal(size=target.shape)
    pose = solve(source, target, weight, "weighted")
    R, t = np.asarray(pose.R), np.asarray(pose.t)
    least = residual(R, t, source, target, weight)
    rng = np.random.default_rng(3)
    for size in (1e-4, 1e-2, 1.0):
        for _ in range(20):
            turned = Rotation.from_rotvec(size * rng.normal(size=(4, 3))).as_matrix() @ R
            assert np.all(residual(turned, t + size * rng.normal(size=t.shape), source, target, weight) > least)


def test_unweighted_centroids_follow_the_released_network_and_are_not_optimal():
    source, target, weight, *_ = problem()
    target += 0.3 * np.random.default_rng(2).normal(size=target.shape)
    pose, best = solve(source, target, weight, "unweighted"), solve(source, target, weight, "weighted")
    H = np.einsum("bk,bki,bkj->bij", weight, source - source.mean(1, keepdims=True), target - target.mean(1, keepdims=True))
    for b in range(4):
        U, _, Vt = np.linalg.svd(H[b])
        V = Vt.T
        if np.linalg.det(V @ U.T) < 0:
            V[:, 2] *= -1
        np.testing.assert_allclose(pose.R[b], V @ U.T, atol=1e-12)
        np.testing.assert_allclose(pose.t[b], weight[b] @ target[b] - V @ U.T @ (weight[b] @ source[b]), atol=1e-12)
    arguments = source, target, weight
    assert np.all(residual(*map(np.asarray, (pose.R, pose.t)), *arguments) > residual(*map(np.asarray, (best.R, best.t)), *arguments))


def test_equal_weights_make_the_two_centroids_one():
    source, target, weight, *_ = problem()
    target, weight = target + 0.3 * np.random.default_rng(2).normal(size=target.shape), np.full_like(weight, 1 / 12)
    a, b = solve(source, target, weight, "weighted"), solve(source, target, weight, "unweighted")
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-12), a, b)


def test_a_mirrored_cloud_still_gives_a_rotation():
    source, _, weight, *_ = problem()
    assert_rotation(np.asarray(solve(source, source * [1, 1, -1], weight, "weighted").R))


def test_planar_and_triangular_clouds_are_enough():
    source, _, weight, R, t = problem()
    source[..., 2] = 0.4 * source[..., 0] - 0.1
    target = source @ R.swapaxes(1, 2) + t[:, None]
    np.testing.assert_allclose(solve(source, target, weight, "weighted").R, R, atol=1e-12)
    three = np.where(np.arange(12) < 3, 1 / 3, 0) * np.ones((4, 1))
    np.testing.assert_allclose(solve(source, target, three, "weighted").R, R, atol=1e-12)


def test_collinear_clouds_and_zero_weights_give_some_rotation():
    source, _, weight, R, t = problem()
    source = source[..., :1] * np.array([1.0, 2.0, -0.5])
    target = source @ R.swapaxes(1, 2) + t[:, None]
    pose = solve(source, target, weight, "weighted")
    assert_rotation(np.asarray(pose.R))
    np.testing.assert_allclose(pose.apply(source), target, atol=1e-12)
    nothing = solve(source, target, np.zeros_like(weight), "weighted")
    np.testing.assert_allclose(nothing.R, np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-12)


def test_projection_maximises_the_trace():
    M = np.random.default_rng(4).normal(size=(30, 3, 3))
    R = np.asarray(project(M))
    assert_rotation(R)
    others = Rotation.random(500, rng=np.random.default_rng(5)).as_matrix()
    assert np.all(np.einsum("bij,oij->bo", M, others) <= np.einsum("bij,bij->b", M, R)[:, None] + 1e-12)


SINGULAR_VALUES = {
    "planar": (2.0, 1.0, 0.0),
    "two equal": (2.0, 2.0, 1.0),
    "last equal": (2.0, 1.0, 1.0),
    "three equal": (1.5, 1.5, 1.5),
    "reflected": (3.0, 2.0, -1.0),
    "reflected, two equal": (2.0, 2.0, -1.0),
}


@jax.jit
def directional(matrix, tangent):
    return jax.jvp(project_to_rotation, (matrix,), (tangent,))[1]


@pytest.mark.parametrize("kind", ["random", "identity", *SINGULAR_VALUES])
def test_derivative_equals_finite_differences(kind):
    V, U = Rotation.random(2, rng=np.random.default_rng(6)).as_matrix()
    M = np.diag(SINGULAR_VALUES.get(kind, (1.0, 1.0, 1.0)))
    M, h = np.random.default_rng(7).normal(size=(3, 3)) if kind == "random" else M if kind == "identity" else V @ M @ U.T, 1e-5
    for tangent in np.random.default_rng(8).normal(size=(3, 3, 3)):
        differences = (project(M + h * tangent) - project(M - h * tangent)) / (2 * h)
        np.testing.assert_allclose(directional(M, tangent), differences, atol=1e-8)


def test_the_derivative_is_finite_where_that_of_the_decomposition_is_not():
    """JAX's derivative of the decomposition is not finite at the identity, whose singular values repeat; that of the rotation is."""

    def derivative(kernels):
        return jax.grad(lambda M: jnp.sum(project_to_rotation(M, kernels) * jnp.arange(9.0).reshape(3, 3)))(jnp.eye(3))

    assert not np.isfinite(derivative("plain")).all()
    for kernels in ("fast", "auto"):
        assert np.isfinite(derivative(kernels)).all()
