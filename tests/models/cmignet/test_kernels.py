"""Plain and fast operations in the whole network: equal losses, gradients and poses, in float64."""

import jax
import numpy as np
import pytest

from cmig_jax.config import ComputeConfig
from cmig_jax.models.cmignet.losses import losses
from cmig_jax.models.cmignet.network import CMIGNet

OVERLAP = {"overlap": True, "overlap_threshold": 0.15, "margins": (1.0, 3.0), "match_threshold": 0.15}
CASES = {
    "paper": {
        "points": {"widths": (8,)},
        "image": {"widths": (16,), "blocks": (1,)},
        "fusion": {"points": "none"},
        "pose": {"gradient": "through"},
        "loss": OVERLAP | {"cross_modal": "paper"},
    },
    "released, idam": {
        "points": {"widths": (8,)},
        "fusion": {"image": "transformer"},
        "keypoints": {"score_from": "other", "activation": "sigmoid"},
        "matching": {"head": "idam", "iterations": 1, "feature_widths": (8,)},
        "pose": {"centroid": "unweighted"},
        "loss": {"cross_modal": "nt-xent", "credibility_label": "index", "match_mean": "positive", "match_threshold": 0.15},
    },
    "corrected, pcrnet": {
        "points": {"widths": (8,)},
        "fusion": {"points": "none", "image": "views"},
        "keypoints": {"select": "random", "test_count": 40},
        "matching": {"head": "pcrnet", "iterations": 1, "repeats": 1},
        "loss": OVERLAP | {"cross_modal": "nt-xent", "overlap_mean": "active"},
    },
}
ROWS = {"paper": 7}  # of the fast version, so that chunks are compared too


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def case(tiny_flags, pairs, random_variables):
    """Return a function from a case's name to flags, variables, and pairs of which a part overlaps; only "paper" encodes images."""

    def draw(name):
        flags, batch, rng = tiny_flags(**CASES[name]), pairs(48, 48, sets=2), np.random.default_rng(1)
        moved = batch.target_from_source.apply(batch.source[:, ::-1])
        batch = batch.replace(target=moved + 0.1 * rng.normal(size=moved.shape))
        with jax.enable_x64(True):
            variables = random_variables(CMIGNet(flags), batch, seed=32, train=True, key=jax.random.key(0))
        return flags, batch if name == "paper" else batch.replace(views=rng.normal(size=(2, 2, 3, 16))), variables

    return draw


def distinct_correspondents(batch, count=32):
    """Choose source points of which no two have the same nearest target point: equal target keypoints would be ties of the matching."""
    moved = batch.target_from_source.apply(batch.source)
    nearest = np.linalg.norm(moved[:, :, None] - batch.target[:, None], axis=-1).argmin(-1)
    return np.stack([np.random.default_rng(2).permutation(np.unique(row, return_index=True)[1])[:count] for row in nearest])


def train(flags, compute, variables, batch, source_index):
    """Return the losses, the gradients of their sum and the new running statistics."""
    network = CMIGNet(flags, compute)

    def total(params):
        state = {**variables, "params": params}
        prediction, new = network.apply(state, batch, train=True, source_index=source_index, mutable=["batch_stats"])
        terms = losses(prediction, batch, flags, compute)
        return sum(terms.values()), (terms, new)

    gradients, (terms, new) = jax.grad(total, has_aux=True)(variables["params"])
    return terms, gradients, new


def assert_close(found, expected):
    """Compare arrays to 1e-8 of the largest of each, and of a millionth of the largest of all."""
    largest = max(np.abs(x).max() for x in jax.tree.leaves(expected))

    def same(path, x, y):
        atol = 1e-8 * max(np.abs(y).max(), 1e-6 * largest)
        np.testing.assert_allclose(x, y, rtol=0, atol=atol, err_msg=jax.tree_util.keystr(path))

    jax.tree_util.tree_map_with_path(same, found, expected)


def plain_and_fast(function, name, flags, *arguments):
    run = jax.jit(function, static_argnums=(0, 1))
    computes = ComputeConfig(kernels="plain"), ComputeConfig(kernels="fast", rows=ROWS.get(name, 0))
    return (run(flags, compute, *arguments) for compute in computes)


@pytest.mark.parametrize("name", CASES)
def test_losses_gradients_and_statistics_are_equal_in_training(name, case):
    flags, batch, variables = case(name)
    plain, fast = plain_and_fast(train, name, flags, variables, batch, distinct_correspondents(batch))
    terms, gradients, _ = plain
    assert all(value > 1e-3 for value in terms.values()), terms
    parts = {part: max(np.abs(x).max() for x in jax.tree.leaves(gradients[part])) for part in gradients}
    assert {part for part, largest in parts.items() if largest == 0} <= ({"views"} if batch.views.ndim == 4 else set())
    for found, expected in zip(fast, plain, strict=True):
        assert_close(found, expected)


@pytest.mark.parametrize("name", [name for name in CASES if name != "paper"])  # `test_network.py` has the paper's
def test_predictions_are_equal_in_evaluation(name, case):
    flags, batch, variables = case(name)

    def evaluate(flags, compute, variables, batch):
        return CMIGNet(flags, compute).apply(variables, batch, train=False)

    plain, fast = plain_and_fast(evaluate, name, flags, variables, batch)
    assert_close(fast, plain)
    assert np.abs(plain.target_from_source.R - np.eye(3)[None]).max() > 0.1
