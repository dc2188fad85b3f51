"""State dict to Flax variables and back."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from flax import traverse_util

from cmig_jax.nn.build import build
from cmig_jax.parity.layout import places
from cmig_jax.parity.recorded import named_weights
from cmig_jax.parity.sizes import SMALL, Sizes, released, sizes_of
from cmig_jax.parity.twin_run import state_shapes
from cmig_jax.parity.weights import by_torch_name, sizes_of_state, to_flax, to_torch
from cmig_jax.training.state import smallest_batch


def same(a, b) -> bool:
    return list(a) == list(b) and all(a[k].dtype == b[k].dtype and np.array_equal(a[k], b[k]) for k in a)


def state_of(sizes: Sizes, seed: int = 0, dtype=np.float32):
    state = named_weights(state_shapes(sizes), seed)
    rng = np.random.default_rng(seed)
    return {
        name: np.asarray(rng.integers(1, 99)) if name.endswith("num_batches_tracked") else value.astype(dtype)
        for name, value in state.items()
    }


@pytest.mark.parametrize("iterations", [1, 2, 5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
def test_round_trip_loses_nothing(iterations, dtype):
    sizes = replace(SMALL, iterations=iterations)
    state = state_of(sizes, dtype=dtype)
    converted = to_flax(state, sizes)
    back, filled = to_torch(converted.variables, sizes, converted.kept)
    assert same(back, state)
    assert not filled


@pytest.mark.parametrize("sizes", [Sizes(), SMALL])
def test_variables_are_the_networks_own(sizes):
    config = released(sizes)
    own = jax.eval_shape(lambda key: build(config).init(key, smallest_batch(config), train=False), jax.random.key(0))
    own = {path: value.shape for path, value in traverse_util.flatten_dict(own).items()}
    variables = to_flax(named_weights(state_shapes(sizes), 0), sizes).variables
    assert {path: value.shape for path, value in traverse_util.flatten_dict(variables).items()} == own


def test_every_tensor_is_placed_or_kept_and_what_is_unused_is_said():
    converted = to_flax(state_of(SMALL), SMALL)
    placed = [place.name for place in places(SMALL)]
    assert len(set(placed)) == len(placed)
    assert set(placed) | set(converted.kept) == set(state_shapes(SMALL))
    left = {name for name in converted.kept if not name.endswith("num_batches_tracked")}
    assert left <= set(converted.unused)
    assert {name.split(".")[0] for name in converted.unused} == {"significance_fc", "MVCNN", "head"}


def test_a_network_that_never_was_in_pytorch_is_filled_up():
    converted = to_flax(state_of(SMALL), SMALL)
    back, filled = to_torch(converted.variables, SMALL)
    assert list(back) == list(state_shapes(SMALL))
    assert set(filled) == set(converted.kept)
    assert not any(back[name].any() for name in filled)


def test_gradients_get_pytorch_names():
    converted = to_flax(state_of(SMALL), SMALL)
    named = by_torch_name({"params": converted.variables["params"]}, SMALL)
    assert all(np.array_equal(named[name], value) for name, value in state_of(SMALL).items() if name in named)
    assert not any("running" in name for name in named)


def test_all_faults_of_a_state_are_named():
    state = state_of(SMALL)
    del state["h3.6.bias"], state["emb_nn.bn1.running_mean"]
    state["sim_mat_Fconv.9.extra"] = np.zeros(3)
    state["significance_fc.conv.4.bias"] = np.zeros(2)
    with pytest.raises(ValueError, match=r"missing emb_nn\.bn1\.running_mean; missing h3\.6\.bias") as error:
        to_flax(state, SMALL)
    assert "surplus sim_mat_Fconv.9.extra" in str(error.value)
    assert "significance_fc.conv.4.bias has shape (2,), expected (1,)" in str(error.value)


def test_all_faults_of_variables_are_named():
    variables = to_flax(state_of(SMALL), SMALL).variables
    variables["params"]["cross_attention"] = {"kernel": np.zeros((2, 2))}
    variables["params"]["score"]["bias"] = np.zeros(3)
    del variables["batch_stats"]["views"]["stem_norm"]["mean"]
    with pytest.raises(ValueError, match="missing batch_stats/views/stem_norm/mean") as error:
        to_torch(variables, SMALL, {"h4.bias": np.zeros(1)})
    for fault in ("surplus params/cross_attention/kernel", "params/score/bias has shape (3,), expected (32,)", "surplus h4.bias"):
        assert fault in str(error.value)


def test_sizes_are_read_off_a_state():
    for sizes in (Sizes(), Sizes(iterations=1), replace(SMALL, iterations=4)):
        hidden = Sizes()
        expected = replace(sizes, k=hidden.k, heads=hidden.heads, keypoints=hidden.keypoints)
        assert sizes_of_state(named_weights(state_shapes(sizes), 0)) == expected
        assert sizes_of(released(sizes).model) == sizes
    with pytest.raises(ValueError, match=r"missing emb_nn\.conv1\.weight"):
        sizes_of_state({"a": np.zeros(2)})
