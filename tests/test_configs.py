"""The presets: each describes a network that can be made, and says what its name promises."""

import dataclasses

import jax
import numpy as np
import pytest

from cmig_jax.config import Config, from_json, to_json
from cmig_jax.nn.build import build, uses_images
from cmig_jax.structs import Batch, Prediction
from cmig_jax.training.checkpoint import differences
from cmig_jax.training.state import smallest_batch
from configs import PRESETS


@pytest.fixture(params=PRESETS)
def preset(request) -> Config:
    return PRESETS[request.param]()


def abstract_batch(config: Config, pairs: int = 2) -> Batch:
    """Describe a batch of the preset's real sizes, without making it."""
    data, views = config.data, config.views
    points = data.points if data.crop == "none" else round(data.points * data.keep)
    sets = 2 if views.of == "both" else 1
    batch = jax.eval_shape(lambda: smallest_batch(config))
    shapes = {
        "source": (pairs, points, 3),
        "target": (pairs, points, 3),
        "views": (pairs, sets, views.count, views.size, views.size, 1),
    }
    described = {name: jax.ShapeDtypeStruct(shape, getattr(batch, name).dtype) for name, shape in shapes.items()}
    pose = jax.tree.map(lambda x: jax.ShapeDtypeStruct((pairs, *x.shape[1:]), x.dtype), batch.target_from_source)
    return batch.replace(**described, target_from_source=pose)


def test_a_preset_survives_its_own_json(preset):
    assert from_json(to_json(preset)) == preset
    assert hash(preset) == hash(from_json(to_json(preset)))


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_named_like_its_run_and_described(name):
    assert PRESETS[name]().name == name
    assert PRESETS[name].__doc__


def test_a_preset_describes_a_network_that_trains_and_predicts(preset):
    model, key, batch = build(preset), jax.random.key(0), abstract_batch(preset)
    variables = jax.eval_shape(lambda: model.init(key, smallest_batch(preset), train=True, key=key))
    trained, updates = jax.eval_shape(lambda v, b: model.apply(v, b, train=True, key=key, mutable=["batch_stats"]), variables, batch)
    assert jax.tree.structure(updates["batch_stats"]) == jax.tree.structure(variables["batch_stats"])
    predicted = jax.eval_shape(lambda v, b: model.apply(v, b, train=False), variables, batch.replace(target_from_source=None))
    m = preset.model
    sizes = (
        (m.matching.iterations, m.keypoints.count),
        (m.matching.iterations + m.matching.repeats, m.keypoints.test_count or m.keypoints.count),
    )
    for prediction, (iterations, keypoints) in zip((trained, predicted), sizes, strict=True):
        assert isinstance(prediction, Prediction)
        assert prediction.target_from_source.R.shape == (2, 3, 3)
        assert prediction.target_from_source.t.shape == (2, 3)
        assert len(prediction.iterations) == iterations
        assert prediction.keypoints.source_index.shape == (2, keypoints)
        assert (prediction.image_features is not None) == uses_images(preset)
    assert sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(variables["params"])) > 10_000


def test_paper_is_the_schema_s_default_and_the_first_column_of_the_table():
    assert PRESETS["paper"]() == Config(name="paper")
    assert values(PRESETS["paper"]()) == {flag: first for flag, (first, _) in TABLE.items()}


def test_released_differs_from_paper_in_the_table_s_second_column_alone():
    assert values(PRESETS["released"]()) == {flag: first if second is None else second for flag, (first, second) in TABLE.items()}
    changed = {line.split(": ")[0] for line in differences(PRESETS["paper"](), PRESETS["released"]())}
    assert changed == {"name"} | {flag for flag, (first, second) in TABLE.items() if second not in (None, first)}


def test_corrected_sees_what_the_sensor_saw_and_predicts_no_keypoints():
    corrected = PRESETS["corrected"]()
    assert (corrected.views.of, corrected.model.fusion.image, corrected.loss.cross_modal) == ("both", "views", "nt-xent")
    assert corrected.model.keypoints.select == "random"


def test_the_corrected_presets_take_all_points_as_keypoints_at_test():
    for name in ("corrected", "corrected-cpu", "quickstart", "own-clouds", "modelnet40-cpu"):
        preset = PRESETS[name]()
        assert preset.model.keypoints.test_count == round(preset.data.points * preset.data.keep)
        assert preset.model.matching.repeats > 0


@pytest.mark.parametrize("name", ["quickstart", "modelnet40-cpu"])
def test_the_small_presets_follow_the_unseen_protocol(name):
    data = PRESETS[name]().data
    assert (data.categories, data.test_categories) == ("first-half", "second-half")
    assert (data.keep, data.crop, data.noise_std, data.max_angle_deg, data.max_translation) == (0.75, "shared", 0.01, 45.0, 0.5)


# Flag: the paper's value, and the released network's where it is another (None: as the paper).
TABLE = {
    "data.sampling": ("once", None),
    "data.keep": (0.75, None),
    "data.crop": ("shared", None),
    "data.noise_std": (0.01, None),
    "data.noise_clip": (0.05, None),
    "data.max_angle_deg": (45.0, None),
    "data.turn": ("positive", None),
    "data.max_translation": (0.5, None),
    "views.of": ("object", None),
    "views.count": (20, None),
    "views.size": (224, None),
    "views.layout": ("dodecahedron", None),
    "model.points.k": (20, None),
    "model.points.widths": ((64, 64, 64, 128), None),
    "model.points.dim": (512, None),
    "model.fusion.points": ("transformer", None),
    "model.fusion.image": ("cross-attention", "transformer"),
    "model.keypoints.select": ("predicted", None),
    "model.keypoints.count": (256, None),
    "model.keypoints.score_from": ("own", "other"),
    "model.keypoints.activation": ("linear", "sigmoid"),
    "model.matching.head": ("cmignet", None),
    "model.matching.iterations": (3, None),
    "model.pose.centroid": ("weighted", "unweighted"),
    "model.pose.gradient": ("stopped", None),
    "loss.overlap": ("on", "off"),
    "loss.overlap_mean": ("all", "active"),
    "loss.margins": ((70.0, 3.0), None),
    "loss.overlap_threshold": (0.01, None),
    "loss.match_threshold": (0.05, None),
    "loss.cross_modal": ("paper", "nt-xent"),
    "loss.temperature": (0.1, None),
    "loss.credibility_label": ("distance", "index"),
    "loss.match_mean": ("all", "positive"),
    "optim.learning_rate": (1e-4, None),
    "optim.weight_decay": (1e-3, None),
    "optim.schedule": ("step", None),
    "optim.milestones": ((50, 75), None),
    "optim.decay": (0.5, None),
    "optim.epochs": (100, None),
    "optim.batch": (6, None),
    "compute.precision": ("float32", None),
    "compute.recompute": ("off", None),
}


def values(config: Config) -> dict[str, object]:
    found = {}
    for flag in TABLE:
        value: object = config
        for name in flag.split("."):
            value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}[name]  # type: ignore[arg-type]
        found[flag] = value
    return found
