"""The global methods of the extra `[baselines]`; skipped, with the reason, if the extra is not installed."""

import json
from dataclasses import replace

import numpy as np
import pytest

from cmig_jax.baselines import ICP_TUNED, FastGlobal, FpfhRansac, KissMatcher, missing
from cmig_jax.baselines.local import icp_rounds
from cmig_jax.baselines.method import no_motion
from cmig_jax.transform import RigidTransform

METHODS = {"FPFH + RANSAC": FpfhRansac(), "FGR": FastGlobal(), "KISS-Matcher": KissMatcher()}


@pytest.fixture(params=list(METHODS))
def method(request):
    if reason := missing().get(request.param):
        pytest.skip(reason)
    return METHODS[request.param]


def test_finds_a_pose_from_any_start(method, pair, errors):
    source, target, true = pair(140, 0.5, points=400, noise=0.005)
    angle, length = errors(method.register(source, target), true)
    assert angle < 2
    assert length < 0.02


def test_refinement_reduces_the_error(method, pair, errors):
    source, target, true = pair(140, 0.5, points=400, noise=0.005)
    coarse, refined = (errors(one.register(source, target), true)[0] for one in (replace(method, refinement=()), method))
    assert refined < coarse < 20


def test_gives_the_same_pose_every_time(method, pair, equal):
    """Also after another pair, whose random numbers must not matter."""
    source, target, _ = pair(60, 0.3, points=300, noise=0.01)
    first = method.register(source, target)
    method.register(target, source)
    equal(first, method.register(source, target))


def test_settings_are_json_values(method):
    settings = method.settings
    assert json.loads(json.dumps(settings)) == settings
    assert settings["length"] == method.length
    assert settings["refinement"] == [None, 0.1]
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
        pose = method.register(source, target)
        np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-6)
        assert np.isfinite(pose.t).all()


def test_without_a_pose_the_refinement_starts_from_the_identity(surface, equal):
    """No point has a neighbour here, so no point has a normal, on which the package alone would abort the process."""
    if reason := missing().get("KISS-Matcher"):
        pytest.skip(reason)
    source, target = surface(50, 0), 1e4 * surface(50, 1)
    equal(KissMatcher(refinement=()).register(source, target), no_motion())
    equal(KissMatcher().register(source, target), ICP_TUNED.register(source, target))


def test_every_search_ends_with_icp_from_its_pose(surface, equal, monkeypatch):
    source, target, start = surface(50, 0), surface(50, 1), RigidTransform(R=np.eye(3), t=np.full(3, 0.05))
    for method in METHODS.values():
        monkeypatch.setattr(type(method), "_search", lambda *_: start)
        equal(method.register(source, target), icp_rounds(source, target, method.refinement, start))


def test_the_limit_of_threads_is_restored(pair):
    if reason := missing().get("FGR"):
        pytest.skip(reason)
    import open3d

    open3d.utility.set_max_threads(2)
    source, target, _ = pair(20, 0.1, points=100)
    FastGlobal().register(source, target)
    assert open3d.utility.get_max_threads() == 2
