"""`paper` and `corrected` beside the twin, in the parts that they share with the released network."""

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from flax import traverse_util

from cmig_jax.config import ComputeConfig
from cmig_jax.models.base import initial_variables
from cmig_jax.models.cmignet.flags import corrected, paper
from cmig_jax.models.cmignet.model import CMIGNET
from cmig_jax.nn.attention import PairTransformer
from cmig_jax.parity.cmignet_compare import run_twin
from cmig_jax.parity.cmignet_layout import layout, named_variables, small
from cmig_jax.parity.cmignet_run import make_batch
from cmig_jax.parity.cmignet_twin import Twin
from cmig_jax.parity.cmignet_twin_parts import take
from cmig_jax.parity.inputs import random_inputs
from cmig_jax.parity.weights import named_weights

torch.set_num_threads(1)
SMALL = replace(small(), matching=replace(small().matching, iterations=1))
TWIN = Twin(SMALL, named_weights(layout(SMALL), 0))
INPUTS = random_inputs(0, pairs=2, points=48, views=3, size=32)


def sized(flags):
    """Other flags with the sizes of the small twin."""
    return replace(
        flags,
        points=SMALL.points,
        image=SMALL.image,
        fusion=replace(flags.fusion, heads=SMALL.fusion.heads, feed_forward=SMALL.fusion.feed_forward),
        keypoints=replace(flags.keypoints, count=24, test_count=min(flags.keypoints.test_count, 30)),
        matching=replace(SMALL.matching, correspondence=flags.matching.correspondence),
    )


def run(flags, view_sets):
    """Run the network with the twin's weights where it has them; return its prediction and what the transformer gave."""
    batch, _ = make_batch(INPUTS, "float64")
    batch = batch.replace(views=jnp.concatenate([batch.views] * view_sets, axis=1))
    network = CMIGNET.build(flags, ComputeConfig(kernels="plain"))
    shapes = jax.eval_shape(lambda: initial_variables(network, flags.needs, jax.random.key(0)))
    shapes, shared = (traverse_util.flatten_dict(tree) for tree in (shapes, named_variables(SMALL, 0)))
    kept = {path: x for path, x in shared.items() if path in shapes}
    assert {path[1] for path in set(shared) - set(kept)} <= ({"score"} if flags.keypoints.select != "predicted" else set())
    rng = np.random.default_rng(0)
    own = {path: 0.1 * rng.standard_normal(x.shape) for path, x in shapes.items() if path not in kept}
    variables = jax.tree.map(jnp.asarray, traverse_util.unflatten_dict(own | kept))

    def apply(variables):
        def transformer(module, _):
            return isinstance(module, PairTransformer)

        prediction, new = network.apply(variables, batch, train=False, mutable=["intermediates"], capture_intermediates=transformer)
        return prediction, new["intermediates"]["transformer"]["__call__"]

    return jax.jit(apply)(variables)


def channels_second(x):
    return torch.tensor(np.array(x)).mT


def close(ours, theirs):
    theirs = theirs.detach().numpy() if isinstance(theirs, torch.Tensor) else theirs
    np.testing.assert_allclose(np.asarray(ours), theirs, rtol=0, atol=1e-8 * np.abs(theirs).max())


@pytest.mark.parametrize(("flags", "view_sets"), [(paper(), 1), (corrected(), 2)])
def test_shared_parts_equal_the_twins(flags, view_sets):
    expected = run_twin(TWIN, INPUTS, train=False)
    with jax.enable_x64(True):
        prediction, transformed = run(sized(flags), view_sets)
        assert prediction.source_features.dtype == jnp.float64
    close(prediction.source_features.mT, expected["feat_src"])
    close(prediction.target_features.mT, expected["feat_tgt"])
    for images in range(view_sets):
        close(prediction.image_features[:, images], expected["feat_views"])
    close(transformed[0].mT, expected["attn_points_0"])
    close(transformed[1].mT, expected["attn_points_1"])

    fused = channels_second(prediction.source_fused), channels_second(prediction.target_fused)
    assert (prediction.source_scores is None) == (flags.keypoints.select != "predicted")
    if prediction.source_scores is not None:  # without the sigmoid, and each by its own cloud's points
        close(nn.sigmoid(prediction.source_scores), TWIN.score(*fused))
        close(nn.sigmoid(prediction.target_scores), TWIN.score(*fused[::-1]))

    chosen, iteration = prediction.keypoints, prediction.iterations[0]
    index = [torch.tensor(np.array(i), dtype=torch.int64) for i in (chosen.source_index, chosen.target_index)]
    clouds = [torch.tensor(INPUTS[name], dtype=torch.float64) for name in ("src", "tgt")]
    found = {}
    TWIN.iterate(tuple(map(take, clouds, index)), tuple(map(take, fused, index)), (), None, found)
    close(iteration.feature_match, found["it0/match_F"])
    close(iteration.coordinate_match, found["it0/match_S"])
    close(iteration.logit, found["it0/logit"])
