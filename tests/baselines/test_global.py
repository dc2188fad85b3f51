"""The global methods of the extra `[baselines]`; skipped, each with its reason, where the extra is not installed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cmig_jax.baselines import FastGlobal, FpfhRansac, KissMatcher, icp_tuned, missing
from cmig_jax.metrics import isotropic_errors

METHODS = {"FPFH + RANSAC": FpfhRansac(), "FGR": FastGlobal(), "KISS-Matcher": KissMatcher()}


@pytest.fixture(params=list(METHODS))
def method(request):
    if reason := missing().get(request.param):
        pytest.skip(reason)
    return METHODS[request.param]


def test_finds_a_pose_from_any_start(method, pair):
    source, target, R_true, t_true = pair(140, 0.5, points=400, noise=0.005)
    R, t = method.register(source, target)
    angle, length = isotropic_errors(R[None], t[None], R_true[None], t_true[None])
    assert angle < 2
    assert length < 0.02


def test_the_finish_sharpens_the_pose(method, pair):
    source, target, R_true, t_true = pair(140, 0.5, points=400, noise=0.005)
    error = {}
    for name, one in {"coarse": replace(method, finish=()), "fine": method}.items():
        R, t = one.register(source, target)
        error[name] = float(isotropic_errors(R[None], t[None], R_true[None], t_true[None])[0][0])
    assert error["fine"] < error["coarse"] < 20


def test_gives_the_same_pose_every_time(method, pair):
    """Also after another pair, whose random numbers must not matter."""
    source, target, *_ = pair(60, 0.3, points=300, noise=0.01)
    first = method.register(source, target)
    method.register(target, source)
    for one, other in zip(first, method.register(source, target), strict=True):
        np.testing.assert_array_equal(one, other)


def test_settings_can_be_written_down(method):
    settings = method.settings
    assert json.loads(json.dumps(settings)) == settings
    assert settings["length"] == method.length
    assert settings["finish"] == [None, 0.1]
    assert settings["package"].split()[1][0].isdigit()


@pytest.mark.parametrize("broken", [np.zeros((2, 3)), np.zeros((5, 2)), np.full((5, 3), np.nan)])
def test_broken_clouds_are_refused(method, broken, surface):
    with pytest.raises(ValueError, match="source"):
        method.register(broken, surface(50, 0))
    with pytest.raises(ValueError, match="target"):
        method.register(surface(50, 0), broken)


@pytest.mark.parametrize(
    "cloud",
    [np.ones((20, 3)), np.linspace(0, 1, 20)[:, None] * np.ones(3), np.eye(3), 100.0 * np.arange(60).reshape(20, 3) ** 2],
    ids=["equal", "collinear", "three", "far apart"],
)
def test_clouds_without_features_give_some_rotation(method, cloud, surface):
    for source, target in ((cloud, surface(50, 0)), (surface(50, 0), cloud), (cloud, cloud)):
        R, t = method.register(source, target)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
        assert np.isfinite(t).all()


def test_a_search_that_finds_nothing_leaves_the_identity_to_the_finish(surface):
    """Here no point has a neighbour, so no point has a normal: left to itself, the package would end the process."""
    if reason := missing().get("KISS-Matcher"):
        pytest.skip(reason)
    source, target = surface(50, 0), 1e4 * surface(50, 1)
    R, t = KissMatcher(finish=()).register(source, target)
    np.testing.assert_array_equal(R, np.eye(3))
    np.testing.assert_array_equal(t, np.zeros(3))
    for found, icp in zip(KissMatcher().register(source, target), icp_tuned(source, target), strict=True):
        np.testing.assert_array_equal(found, icp)


def test_the_limit_of_threads_is_put_back(pair):
    if reason := missing().get("FGR"):
        pytest.skip(reason)
    import open3d

    open3d.utility.set_max_threads(2)
    source, target, *_ = pair(20, 0.1, points=100)
    FastGlobal().register(source, target)
    assert open3d.utility.get_max_threads() == 2
