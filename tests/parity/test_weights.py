"""State dict to Flax variables and back; the names, shapes and order of the released state."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from flax import traverse_util

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import initial_variables
from cmig_jax.models.cmignet.flags import released
from cmig_jax.models.cmignet.model import CMIGNET
from cmig_jax.parity.cmignet_layout import UNUSED, flags_of_state, layout, named_variables, small
from cmig_jax.parity.weights import Tensor, by_torch_name, named_weights, to_flax, to_torch

from .recording import GOLDEN

SMALL = small()


def same(a, b) -> bool:
    return list(a) == list(b) and all(a[k].dtype == b[k].dtype and np.array_equal(a[k], b[k]) for k in a)


def iterated(count):
    return replace(SMALL, matching=replace(SMALL.matching, iterations=count))


def state_of(flags, seed: int = 0, dtype=np.float32):
    rng = np.random.default_rng(seed)
    return {
        name: np.asarray(rng.integers(1, 99)) if name.endswith("num_batches_tracked") else value.astype(dtype)
        for name, value in named_weights(layout(flags), seed).items()
    }


def test_weights_depend_on_name_and_seed_alone():
    shapes = {
        "a.weight": (4, 3),
        "a.bias": (4,),
        "bn.weight": (4,),
        "bn.running_var": (4,),
        "x.num_batches_tracked": (),
        "h.reflect": (3, 3),
    }
    tensors = [Tensor(name, shape) for name, shape in shapes.items()]
    first, again = named_weights(tensors, 0), named_weights(tensors[::-1], 0)
    assert all(np.array_equal(first[name], again[name]) for name in shapes)
    assert not np.array_equal(first["a.weight"], named_weights(tensors, 1)["a.weight"])
    assert (first["bn.running_var"] >= 1).all()
    assert np.array_equal(first["h.reflect"], np.diag([1, 1, -1]))
    assert first["x.num_batches_tracked"].dtype == np.int64


def test_known_weights():
    weights = named_weights([Tensor("h3.6.weight", (1, 4, 1)), Tensor("h3.6.bias", (1,))], 0)
    assert weights["h3.6.weight"].ravel() == pytest.approx([-0.22457108, -0.73310759, -0.33217256, 0.70139021])
    assert weights["h3.6.bias"] == pytest.approx([0.05550615])


def test_the_state_has_the_released_size():
    counted = ("running_mean", "running_var", "num_batches_tracked")
    assert sum(int(np.prod(t.shape)) for t in layout(released()) if not t.name.endswith(counted)) == 18_106_876


@pytest.mark.skipif(not GOLDEN.is_dir(), reason="no recorded cases here")
def test_the_state_is_the_released_one():
    recorded = {name: tuple(shape) for name, shape in json.loads((GOLDEN / "state_dict_shapes.json").read_text()).items()}
    assert [(tensor.name, tensor.shape) for tensor in layout(released())] == list(recorded.items())


@pytest.mark.parametrize("iterations", [1, 2, 5])
@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
def test_round_trip_loses_nothing(iterations, dtype):
    state, tensors = state_of(iterated(iterations), dtype=dtype), layout(iterated(iterations))
    variables, beside = to_flax(state, tensors)
    back, filled = to_torch(variables, tensors, beside)
    assert same(back, state)
    assert not filled


@pytest.mark.parametrize("flags", [released(), SMALL])
def test_variables_are_the_networks_own(flags):
    module = CMIGNET.build(flags, ComputeConfig())
    own = jax.eval_shape(lambda: initial_variables(module, flags.needs, jax.random.key(0)))
    shapes = [{path: x.shape for path, x in traverse_util.flatten_dict(tree).items()} for tree in (own, named_variables(flags, 0))]
    assert shapes[0] == shapes[1]


def test_every_tensor_is_placed_or_kept_and_only_unused_ones_are_kept():
    tensors = layout(SMALL)
    variables, beside = to_flax(state_of(SMALL), tensors)
    placed = by_torch_name(variables, tensors)
    assert set(placed) | set(beside) == {tensor.name for tensor in tensors}
    assert not set(placed) & set(beside)
    assert {name for name in beside if not name.endswith("num_batches_tracked")} == {
        name for name in state_of(SMALL) if name.startswith(UNUSED) and not name.endswith("num_batches_tracked")
    }


def test_a_network_that_never_was_in_pytorch_is_filled_up():
    variables, beside = to_flax(state_of(SMALL), layout(SMALL))
    back, filled = to_torch(variables, layout(SMALL), {})
    assert list(back) == [tensor.name for tensor in layout(SMALL)]
    assert set(filled) == set(beside)
    assert not any(back[name].any() for name in filled)


def test_gradients_get_pytorch_names():
    variables, _ = to_flax(state_of(SMALL), layout(SMALL))
    named = by_torch_name({"params": variables["params"]}, layout(SMALL))
    assert all(np.array_equal(named[name], value) for name, value in state_of(SMALL).items() if name in named)
    assert not any("running" in name for name in named)


def test_all_faults_of_a_state_are_named():
    state = state_of(SMALL)
    del state["h3.6.bias"], state["emb_nn.bn1.running_mean"]
    state["sim_mat_Fconv.9.extra"] = np.zeros(3)
    state["significance_fc.conv.4.bias"] = np.zeros(2)
    with pytest.raises(ValueError, match=r"missing emb_nn\.bn1\.running_mean; missing h3\.6\.bias") as error:
        to_flax(state, layout(SMALL))
    assert "surplus sim_mat_Fconv.9.extra" in str(error.value)
    assert "significance_fc.conv.4.bias has shape (2,), expected (1,)" in str(error.value)


def test_all_faults_of_variables_are_named():
    variables, _ = to_flax(state_of(SMALL), layout(SMALL))
    variables["params"]["cross_attention"] = {"kernel": np.zeros((2, 2))}
    variables["params"]["score"]["bias"] = np.zeros(3)
    del variables["batch_stats"]["views"]["stem_norm"]["mean"]
    with pytest.raises(ValueError, match="missing batch_stats/views/stem_norm/mean") as error:
        to_torch(variables, layout(SMALL), {"h4.bias": np.zeros(1)})
    for fault in ("surplus params/cross_attention/kernel", "params/score/bias has shape (3,), expected (32,)", "surplus h4.bias"):
        assert fault in str(error.value)


@pytest.mark.parametrize("flags", [released(), SMALL, iterated(4)])
def test_sizes_are_read_off_a_state(flags):
    found, base = flags_of_state({tensor.name: np.empty(tensor.shape) for tensor in layout(flags)}), released()
    assert found == replace(
        flags,
        points=replace(flags.points, k=base.points.k),
        fusion=replace(flags.fusion, heads=base.fusion.heads),
        keypoints=replace(flags.keypoints, count=base.keypoints.count),
    )


def test_what_is_no_such_state_is_refused():
    with pytest.raises(ValueError, match=r"missing emb_nn\.conv1\.weight"):
        flags_of_state({"a": np.zeros(2)})
    with pytest.raises(ValueError, match=r"missing preweight\.0\.conv\.0\.weight"):
        flags_of_state({name: value for name, value in state_of(SMALL).items() if not name.startswith("preweight")})
