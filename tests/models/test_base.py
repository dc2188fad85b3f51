"""What a network says it needs: exactly that suffices, and one point fewer is refused."""

import dataclasses
import functools
import re

import flax.linen as nn
import jax
import jax.numpy as jnp
import pytest

from cmig_jax.config import ComputeConfig, Needs
from cmig_jax.models.base import initial_variables, predict, smallest_batch
from cmig_jax.models.cmignet.flags import CMIGNetFlags, FusionFlags, ImageFlags, KeypointsFlags, LossFlags, MatchingFlags, PointsFlags
from cmig_jax.models.networks import NETWORKS, model_of

IMAGES, NO_IMAGES = FusionFlags(), FusionFlags(image="none")
# Flags of the keypoints and of the fusion, whether there is a loss on images, and what such a network needs.
CASES = {
    "keypoints": (KeypointsFlags(count=11), NO_IMAGES, False, Needs(11, 11)),
    "random keypoints": (KeypointsFlags(count=11, select="random"), NO_IMAGES, False, Needs(11, 11)),
    "more keypoints at test": (KeypointsFlags(count=11, test_count=40), IMAGES, True, Needs(6, 11, pairs=2, views=True)),
    "neighbours": (KeypointsFlags(count=5), NO_IMAGES, False, Needs(6, 6)),
    "all points": (KeypointsFlags(select="all"), NO_IMAGES, False, Needs(6, 6)),
    "scores of the other cloud": (KeypointsFlags(count=11, score_from="other"), NO_IMAGES, False, Needs(11, 11, equal_sizes=True)),
    "images for a loss": (KeypointsFlags(count=11), NO_IMAGES, True, Needs(11, 11, pairs=2, views=True)),
    "images without a loss": (KeypointsFlags(count=11), IMAGES, False, Needs(11, 11, views=True)),
}


def tiny(keypoints, fusion, image_loss, k=6):
    return CMIGNetFlags(
        points=PointsFlags(k=k, widths=(4,), dim=8),
        image=ImageFlags(widths=(8,), blocks=(1,)),
        fusion=dataclasses.replace(fusion, heads=2, feed_forward=4),
        keypoints=keypoints,
        matching=MatchingFlags(iterations=1, feature_widths=(4,), coordinate_widths=(4,)),
        loss=LossFlags(cross_modal="nt-xent" if image_loss else "off"),
    )


def fewer(batch, points):
    return batch.replace(source=batch.source[:, :points], target=batch.target[:, :points])


@pytest.mark.parametrize("name", CASES)
def test_exactly_the_points_that_are_needed_suffice(name):
    *choices, needs = CASES[name]
    flags = tiny(*choices)
    assert flags.needs == needs
    network, key = model_of(flags).build(flags, ComputeConfig()), jax.random.key(0)
    batch = smallest_batch(needs)
    assert batch.source.shape == batch.target.shape == (1, needs.training_points, 3)
    assert (batch.views is not None) == needs.views
    variables = jax.eval_shape(functools.partial(initial_variables, network, needs), key)
    assert set(variables) == {"params", "batch_stats"}

    def train(variables, batch):
        return network.apply(variables, batch, train=True, key=key, mutable=["batch_stats"])[0]

    evaluate = functools.partial(predict, network)
    for run, fewest in ((train, needs.training_points), (evaluate, needs.points)):
        found = jax.eval_shape(run, variables, fewer(batch, fewest))
        assert found.target_from_source.R.shape == (1, 3, 3)
        message = f"expected at least {fewest} points (neighbours, keypoints) in each cloud, got {fewest - 1} and {fewest - 1}"
        with pytest.raises(ValueError, match=re.escape(message)):
            jax.eval_shape(run, variables, fewer(batch, fewest - 1))
    other = fewer(batch, needs.points).replace(target=jnp.zeros((1, needs.points + 2, 3)))
    if needs.equal_sizes:
        with pytest.raises(ValueError, match=f"expected N = M, got {needs.points} and {needs.points + 2} points"):
            jax.eval_shape(evaluate, variables, other)
    else:
        jax.eval_shape(evaluate, variables, other)


def test_no_network_takes_fewer_than_three_points():
    assert tiny(KeypointsFlags(select="all"), NO_IMAGES, False, k=1).needs == Needs(points=3, training_points=3)


def test_a_network_without_running_statistics_has_an_empty_collection():
    class Module(nn.Module):
        @nn.compact
        def __call__(self, batch, *, train, key=None):
            return self.param("w", nn.initializers.zeros, batch.source.shape)

    variables = initial_variables(Module(), Needs(points=5), jax.random.key(0))
    assert jax.tree.map(jnp.shape, variables) == {"params": {"w": (1, 5, 3)}, "batch_stats": {}}


def test_networks_are_listed_by_the_name_that_their_flags_give():
    for name, model in NETWORKS.items():
        assert name == model.name == model.flags.network
        assert model_of(model.flags()) is model

    class OtherFlags(CMIGNetFlags):
        network = "other"

    with pytest.raises(ValueError, match=r"network = 'other': expected one of cmignet"):
        model_of(OtherFlags())
