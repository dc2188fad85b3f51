"""`paper` and `corrected` beside the twin, in the parts that they share with the released network."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from flax import traverse_util

from cmig_jax.nn.attention import PairTransformer
from cmig_jax.nn.build import build
from cmig_jax.parity.flax_run import make_batch
from cmig_jax.parity.recorded import named_weights, random_inputs
from cmig_jax.parity.sizes import SMALL, released
from cmig_jax.parity.twin_matching import coordinate_pairs, feature_pairs
from cmig_jax.parity.twin_run import make_twin, run_twin, state_shapes
from cmig_jax.parity.weights import to_flax
from cmig_jax.structs import Batch
from configs.modelnet40 import corrected, paper

torch.set_num_threads(1)
SIZES = replace(SMALL, iterations=1)
STATE = named_weights(state_shapes(SIZES), 0)
INPUTS = random_inputs(0, pairs=2, points=48, views=3, size=32)


def small(preset):
    """A preset with the sizes of the small twin."""
    sized, ours = released(SIZES).model, preset().model
    return replace(
        preset(),
        model=replace(
            sized,
            fusion=replace(sized.fusion, points=ours.fusion.points, image=ours.fusion.image),
            keypoints=replace(sized.keypoints, score_from=ours.keypoints.score_from, activation=ours.keypoints.activation),
            pose=ours.pose,
        ),
    )


def run(config):
    """Run the network with the twin's weights where it has them."""
    network, batch = build(config), make_batch(INPUTS, "float64")
    if config.views.of == "both":
        assert batch.views is not None
        batch = Batch(batch.source, batch.target, jnp.concatenate([batch.views, batch.views], axis=1), batch.target_from_source)
    shapes = traverse_util.flatten_dict(jax.eval_shape(lambda key: network.init(key, batch, train=False), jax.random.key(0)))
    shared = traverse_util.flatten_dict(to_flax(STATE, SIZES).variables)
    assert set(shared) <= set(shapes)  # everything that the released network has
    rng = np.random.default_rng(0)
    own = {path: 0.1 * rng.standard_normal(x.shape) for path, x in shapes.items() if path not in shared}
    variables = jax.tree.map(jnp.asarray, traverse_util.unflatten_dict(own | shared))

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


@pytest.mark.parametrize("preset", [paper, corrected])
def test_shared_parts_equal_the_twins(preset):
    config = small(preset)
    twin = make_twin(SIZES, STATE)
    expected = run_twin(twin, INPUTS, train=False).outputs
    with jax.enable_x64(True):
        prediction, transformed = run(config)
        assert prediction.source_features.dtype == jnp.float64
    close(prediction.source_features.mT, expected["feat_src"])
    close(prediction.target_features.mT, expected["feat_tgt"])
    for images in range(prediction.image_features.shape[1]):
        close(prediction.image_features[:, images], expected["feat_views"])
    close(transformed[0].mT, expected["attn_points_0"])
    close(transformed[1].mT, expected["attn_points_1"])

    fused_source, fused_target = channels_second(prediction.source_fused), channels_second(prediction.target_fused)
    for scores, own, other in (
        (prediction.source_scores, fused_source, fused_target),
        (prediction.target_scores, fused_target, fused_source),
    ):
        beside = other.amax(-1, keepdim=True).expand_as(own)
        close(scores, twin.h3(torch.cat((own, beside), dim=1)).squeeze(1))

    chosen, iteration = prediction.keypoints, prediction.iterations[0]
    index = [torch.tensor(np.array(i)).unsqueeze(1) for i in (chosen.source_index, chosen.target_index)]
    features = [x.gather(2, i.expand(-1, x.shape[1], -1)) for x, i in zip((fused_source, fused_target), index, strict=True)]
    clouds = [torch.tensor(x, dtype=torch.float64) for x in (INPUTS.src, INPUTS.tgt)]
    points = [x.gather(2, i.expand(-1, 3, -1)) for x, i in zip(clouds, index, strict=True)]
    match_F, match_S = twin.sim_mat_Fconv[0](feature_pairs(*features)), twin.sim_mat_Sconv[0](coordinate_pairs(*points))
    close(iteration.feature_match, match_F.squeeze(1))
    close(iteration.coordinate_match, match_S.squeeze(1))
    close(iteration.logit, twin.weight_fc[0](twin.preweight[0](torch.cat((match_F, match_S), dim=1)).amax(-1)).squeeze(1))
