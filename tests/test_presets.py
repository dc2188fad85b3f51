"""The presets: each describes a network that can be built, and the settings that its name promises; the scales shrink them."""

import functools
from typing import Any

import jax
import numpy as np
import pytest

from cmig_jax.config import Config
from cmig_jax.config_json import differences, flat, to_json
from cmig_jax.models.base import initial_variables, predict
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.models.networks import config_from_json, model_of
from cmig_jax.structs import Batch, Prediction
from cmig_jax.transform import RigidTransform
from configs import PRESETS
from configs.methods import METHODS
from configs.scale import SCALES

CORRECTED = ("corrected", "corrected-cpu", "quickstart", "own-clouds-cmignet", "modelnet40-cpu")


SMALL_METHODS = {name for name in METHODS if name.endswith("-cpu")}  # `tests/experiments/test_rows.py` traces such networks too


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.slow if name in SMALL_METHODS else ()) for name in PRESETS])
def preset(request) -> Config:
    return PRESETS[request.param]()


def abstract_batch(config: Config, pairs: int = 2) -> Batch:
    """Describe a batch of the preset's real sizes, without making it."""
    views, data, needs = config.views, config.data, config.model.needs

    def array(*shape, dtype=np.float32):
        return jax.ShapeDtypeStruct((pairs, *shape), dtype)

    return Batch(
        source=array(data.cropped_points, 3),
        target=array(data.target_points, 3),
        views=array(views.sets, views.count, views.size, views.size, 1, dtype=np.uint8) if needs.views else None,
        target_from_source=RigidTransform(R=array(3, 3), t=array(3)),
        source_normals=array(data.cropped_points, 3) if needs.normals else None,
        target_normals=array(data.target_points, 3) if needs.normals else None,
    )


def test_a_preset_survives_its_own_json(preset):
    assert config_from_json(to_json(preset)) == preset
    assert hash(preset) == hash(config_from_json(to_json(preset)))


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_named_like_its_run_and_described(name):
    assert PRESETS[name]().name == name
    assert PRESETS[name].__doc__


def assert_sized(prediction: Any, flags: CMIGNetFlags, iterations: int, keypoints: int) -> None:
    assert len(prediction.iterations) == iterations
    assert prediction.keypoints.source_index.shape == (2, keypoints)
    assert (prediction.image_features is not None) == flags.needs.views


def test_a_preset_describes_a_network_that_trains_and_predicts(preset):
    flags, key, batch = preset.model, jax.random.key(0), abstract_batch(preset)
    assert preset.optim.batch >= flags.needs.pairs
    assert preset.data.cropped_points >= max(flags.needs.points, flags.needs.training_points)
    model = model_of(flags)
    network = model.build(flags, preset.compute)
    variables = jax.eval_shape(functools.partial(initial_variables, network, flags.needs), key)

    def train(variables, batch):
        prediction, updates = network.apply(variables, batch, train=True, key=key, mutable=["batch_stats"])
        return prediction, updates, model.losses(prediction, batch, flags, preset.compute)

    trained, updates, losses = jax.eval_shape(train, variables, batch)
    assert jax.tree.structure(updates["batch_stats"]) == jax.tree.structure(variables["batch_stats"])
    assert {loss.shape for loss in losses.values()} == {()}
    predicted = jax.eval_shape(functools.partial(predict, network), variables, batch.replace(target_from_source=None))
    for prediction in (trained, predicted):
        assert isinstance(prediction, Prediction)
        assert prediction.target_from_source.R.shape == (2, 3, 3)
        assert prediction.target_from_source.t.shape == (2, 3)
    if isinstance(flags, CMIGNetFlags):
        assert_sized(trained, flags, flags.matching.iterations, flags.keypoints.count)
        iterations = flags.matching.iterations + flags.matching.repeats
        assert_sized(predicted, flags, iterations, flags.keypoints.test_count or flags.keypoints.count)
    assert sum(x.size for x in jax.tree.leaves(variables["params"])) > 10_000


DATA = {"name", "data.source", "data.sampling", "data.crop", "data.keep", "data.pose", "data.turn", "data.noise_std", "views.of"}
MODEL = ("fusion.points", "fusion.image", "keypoints.select", "matching.head", "matching.repeats", "pose.centroid", "loss.cross_modal")
METHOD = ("iterations", "pointer", "matching", "jacobian", "residual_loss", "loss", "cycle", "sinkhorn_rounds", "unmasked", "share")


@pytest.mark.parametrize("scale", SCALES)
def test_a_scale_keeps_what_is_computed_and_from_what_data(preset, scale):
    small = SCALES[scale](preset)
    kept = DATA | {f"model.{flag}" for flag in (*MODEL, *(METHOD if scale == "cpu" else ()))}
    assert not kept & {line.split(": ")[0] for line in differences(preset, small)}
    if scale == "short":
        assert {line.split(": ")[0] for line in differences(preset, small)} == {"optim.epochs"}
    else:
        assert small == preset if scale == "full" else small == SCALES[scale](small)
    needs = small.model.needs
    assert small.data.cropped_points >= max(needs.points, needs.training_points)
    assert small.optim.batch >= needs.pairs
    if isinstance(small.model, CMIGNetFlags):
        assert isinstance(preset.model, CMIGNetFlags)
        assert small.data.cropped_points >= small.model.keypoints.test_count
        assert (small.model.keypoints.test_count > 0) == (preset.model.keypoints.test_count > 0)


def test_corrected_uses_observed_views_and_predicts_no_keypoints():
    corrected = PRESETS["corrected"]()
    assert (corrected.views.of, corrected.model.fusion.image, corrected.model.loss.cross_modal) == ("both", "views", "nt-xent")
    assert corrected.model.keypoints.select == "random"


@pytest.mark.parametrize("name", CORRECTED)
def test_the_corrected_presets_take_all_points_as_keypoints_at_test(name):
    preset = PRESETS[name]()
    assert preset.model.keypoints.test_count == preset.data.cropped_points
    assert preset.model.matching.repeats > 0


@pytest.mark.parametrize("name", ["quickstart", "modelnet40-cpu"])
def test_the_small_presets_follow_the_unseen_protocol(name):
    data = PRESETS[name]().data
    assert (data.categories, data.test_categories) == ("first-half", "second-half")
    assert (data.keep, data.crop, data.noise_std, data.max_angle_deg, data.max_translation) == (0.75, "shared", 0.01, 45.0, 0.5)


PAPER_BY_GROUP = [
    ("data.", {"sampling": "once", "keep": 0.75, "crop": "shared", "noise_std": 0.01, "noise_clip": 0.05}),
    ("data.", {"max_angle_deg": 45.0, "turn": "positive", "max_translation": 0.5}),
    ("views.", {"of": "object", "count": 20, "size": 224, "layout": "dodecahedron"}),
    ("model.points.", {"k": 20, "widths": (64, 64, 64, 128), "dim": 512}),
    ("model.fusion.", {"points": "transformer", "image": "cross-attention"}),
    ("model.keypoints.", {"select": "predicted", "count": 256, "score_from": "own", "activation": "linear"}),
    ("model.matching.", {"head": "cmignet", "iterations": 3}),
    ("model.pose.", {"centroid": "weighted", "gradient": "stopped"}),
    ("model.loss.", {"overlap": True, "overlap_mean": "all", "margins": (70.0, 3.0), "overlap_threshold": 0.01}),
    ("model.loss.", {"cross_modal": "paper", "temperature": 0.1}),
    ("model.loss.", {"match_threshold": 0.05, "credibility_label": "distance", "match_mean": "all"}),
    ("optim.", {"learning_rate": 1e-4, "weight_decay": 1e-3, "schedule": "step", "milestones": (50, 75), "decay": 0.5}),
    ("optim.", {"epochs": 100, "batch": 6}),
    ("compute.", {"precision": "float32", "recompute": False}),
]
PAPER = {group + name: value for group, flags in PAPER_BY_GROUP for name, value in flags.items()}
RELEASED = {  # what differs from the paper's values
    "model.fusion.image": "transformer",
    "model.keypoints.score_from": "other",
    "model.keypoints.activation": "sigmoid",
    "model.pose.centroid": "unweighted",
    "model.loss.overlap": False,
    "model.loss.overlap_mean": "active",
    "model.loss.cross_modal": "nt-xent",
    "model.loss.credibility_label": "index",
    "model.loss.match_mean": "positive",
}


def test_paper_has_the_schema_s_defaults_and_the_paper_s_values():
    assert PRESETS["paper"]() == Config(name="paper", model=CMIGNetFlags())
    assert PAPER.items() <= flat(PRESETS["paper"]()).items()


def test_released_differs_from_paper_only_in_the_released_network_s_values():
    assert flat(PRESETS["released"]()) == flat(PRESETS["paper"]()) | RELEASED | {"name": "released"}
