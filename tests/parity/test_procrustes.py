"""The closed-form derivative of the pose solver against PyTorch's, through its SVD, where that is finite."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

from cmig_jax.ops.procrustes import weighted_procrustes
from cmig_jax.parity.cmignet_twin_parts import solve


def torch_derivative(source, target, weight, R_bar, t_bar, centroid):
    x, y, w = (torch.tensor(v, requires_grad=True) for v in (source, target, weight))
    if centroid == "unweighted":
        R, t = solve(x[None].mT, y[None].mT, w[None])
        R, t = R[0], t[0]
    else:
        mean_x, mean_y = w @ x, w @ y
        U, _, Vh = torch.linalg.svd((x - mean_x).T @ torch.diag(w) @ (y - mean_y))
        sign = torch.diag(torch.stack([torch.ones(()), torch.ones(()), torch.det(Vh.T @ U.T).sign()]).to(x.dtype))
        R = Vh.T @ sign @ U.T
        t = mean_y - R @ mean_x
    (torch.tensor(R_bar) * R).sum().add((torch.tensor(t_bar) * t).sum()).backward()
    return R.detach().numpy(), t.detach().numpy(), [v.grad.numpy() for v in (x, y, w)]


@pytest.mark.parametrize("centroid", ["weighted", "unweighted"])
@pytest.mark.parametrize("reflected", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_derivative_equals_autograd(seed, reflected, centroid):
    rng = np.random.default_rng(seed)
    source = rng.standard_normal((12, 3)) * [1.0, 0.7, 0.4]
    target = source @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + 0.1 * rng.standard_normal((12, 3))
    if reflected:
        target[:, 0] *= -1
    weight = rng.uniform(0.1, 1, 12)
    weight /= weight.sum()
    R_bar, t_bar = rng.standard_normal((3, 3)), rng.standard_normal(3)
    R, t, expected = torch_derivative(source, target, weight, R_bar, t_bar, centroid)
    with jax.enable_x64(True):

        def functional(x, y, w):
            pose = weighted_procrustes(x, y, w, centroid)
            return jnp.sum(R_bar * pose.R) + jnp.sum(t_bar * pose.t), pose

        arguments = (jnp.asarray(source), jnp.asarray(target), jnp.asarray(weight))
        ours, pose = jax.grad(functional, argnums=(0, 1, 2), has_aux=True)(*arguments)
    np.testing.assert_allclose(pose.R, R, atol=1e-12)
    np.testing.assert_allclose(pose.t, t, atol=1e-12)
    for a, b in zip(ours, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-10 * np.abs(b).max())


def test_ours_is_finite_where_autograd_is_not():
    """Two equal singular values: the rotation is smooth there, the SVD is not."""
    source = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]])
    weight = np.full(6, 1 / 6)
    _, _, theirs = torch_derivative(source, source, weight, np.arange(9.0).reshape(3, 3), np.zeros(3), "weighted")
    assert not all(np.isfinite(g).all() for g in theirs)
    with jax.enable_x64(True):
        arguments = [jnp.asarray(v) for v in (source, source, weight)]
        bar = jnp.arange(9.0).reshape(3, 3)
        ours = jax.grad(lambda *a: jnp.sum(bar * weighted_procrustes(*a, "weighted").R), argnums=(0, 1, 2))(*arguments)
    assert all(np.isfinite(g).all() for g in ours)
