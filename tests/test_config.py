"""The schema: what it writes it reads, and what it refuses it names."""

import dataclasses
import json
import math
import re

import pytest

from cmig_jax.config import Config, FusionConfig, ModelConfig, ViewsConfig, _rules, from_json, to_json

REFUSED = {
    "name": ["", "../elsewhere", "/anywhere"],
    "seed": [-1],
    "data.max_translation": [-0.5, math.inf],
    "data.test_seed": [-1],
    "data.workers": [-1],
    "model.points.widths": [(), (64, 0)],
    "model.points.dim": [2],
    "model.fusion.feed_forward": [0],
    "model.matching.feature_widths": [()],
    "model.matching.coordinate_widths": [(0,)],
    "loss.overlap_threshold": [0.0],
    "loss.match_threshold": [-0.05],
    "loss.margins": [(-1.0, 3.0)],
    "optim.weight_decay": [-1e-3],
    "optim.milestones": [(0,), (50, 50), (75, 50)],
    "optim.decay": [0.0, 2.0],
    "optim.clip_norm": [-1.0],
    "data.points": [0],
    "data.keep": [0.0, 1.5, -0.1],
    "data.noise_std": [-0.01, math.inf],
    "data.noise_clip": [-0.05],
    "data.max_angle_deg": [-1.0, 181.0],
    "data.validation": [0.0, 1.0],
    "data.shapes": [3],
    "views.count": [12, 0],
    "views.size": [7],
    "model.points.k": [0, 769],
    "model.keypoints.count": [1, 769],
    "model.keypoints.test_count": [-1],
    "model.image.widths": [(64, 128, 256, 511)],
    "model.image.blocks": [(2, 2, 2)],
    "model.fusion.heads": [0, 3],
    "model.matching.iterations": [0],
    "model.matching.repeats": [-1],
    "loss.temperature": [0.0],
    "optim.batch": [1],
    "optim.epochs": [0],
    "optim.validate_every": [0],
    "optim.learning_rate": [0.0],
    "compute.rows": [-1],
}


def changed(config, flag, value):
    """Replace one flag, named by its path."""
    name, _, rest = flag.partition(".")
    return dataclasses.replace(config, **{name: changed(getattr(config, name), rest, value) if rest else value})


def edited(flag, edit):
    """Write the default config as JSON with the object that holds `flag` edited."""
    values = json.loads(to_json(Config()))
    inner, path = values, flag.split(".")
    for name in path[:-1]:
        inner = inner[name]
    edit(inner, path[-1])
    return json.dumps(values)


def test_json_round_trip_keeps_every_flag():
    config = Config(name="mine", seed=7, views=ViewsConfig(count=12, layout="ring"), model=ModelConfig(fusion=FusionConfig(image="views")))
    config = changed(config, "data.noise_std", 0.0)
    assert from_json(to_json(config)) == config
    assert from_json(to_json(config)) != Config()


def test_sequences_come_back_as_tuples_so_that_configs_stay_hashable():
    config = from_json(to_json(Config()))
    assert config.model.points.widths == (64, 64, 64, 128)
    assert hash(config) == hash(Config())


@pytest.mark.parametrize(("flag", "value"), [(flag, value) for flag, values in REFUSED.items() for value in values])
def test_a_refused_value_is_named_with_its_flag_and_what_was_expected(flag, value):
    with pytest.raises(ValueError, match=re.escape(f"{flag} = {value}") + ".*: expected .+"):
        changed(Config(), flag, value)


def test_every_rule_is_tested_above():
    ruled = {name.split(" = ")[0] for name, _, _ in _rules(Config())}
    assert ruled == set(REFUSED) | {"model.fusion.image"}


def test_tied_image_fusion_needs_the_transformer_whose_weights_it_shares():
    with pytest.raises(ValueError, match=r"model\.fusion\.image = transformer with model\.fusion\.points = none"):
        changed(Config(), "model.fusion", FusionConfig(points="none", image="transformer"))


def test_rules_bind_only_where_the_flag_is_used():
    no_views = changed(changed(Config(), "loss.cross_modal", "off"), "model.fusion.image", "none")
    assert changed(no_views, "optim.batch", 1).optim.batch == 1
    assert changed(no_views, "model.image.widths", (8, 8, 8, 8)).model.points.dim == 512
    everything = changed(Config(), "model.keypoints.select", "all")
    assert changed(everything, "model.keypoints.count", 100_000).model.keypoints.select == "all"
    assert changed(changed(Config(), "data.crop", "none"), "model.keypoints.count", 1024).data.crop == "none"


@pytest.mark.parametrize(("flag", "value"), [("data.crop", "half"), ("model.matching.head", 3), ("loss.overlap", True), ("views.of", None)])
def test_a_value_outside_its_choices_is_named(flag, value):
    text = edited(flag, lambda inner, name: inner.__setitem__(name, value))
    with pytest.raises(ValueError, match=re.escape(f"config.{flag} = {value!r}: expected one of ")):
        from_json(text)


@pytest.mark.parametrize(("flag", "value"), [("optim.batch", 6), ("data.exclude", ()), ("views.shown", "real"), ("views", ViewsConfig())])
def test_a_flag_that_is_younger_than_the_file_has_its_default(flag, value):
    config = from_json(edited(flag, lambda inner, name: inner.pop(name)))
    assert config == Config()
    for name in flag.split("."):
        config = getattr(config, name)
    assert config == value


def test_the_defaults_of_younger_flags_are_what_was_done_before_them():
    """`exclude` and `shown` are younger than the first trained networks: nothing was left out, and the pair's own views were shown."""
    values = json.loads(to_json(changed(changed(Config(), "data.exclude", ("cup",)), "views.shown", "zero")))
    del values["data"]["exclude"], values["views"]["shown"]
    assert from_json(json.dumps(values)) == Config()


def test_names_come_back_as_a_tuple():
    config = changed(Config(), "data.exclude", ("cup", "vase"))
    assert from_json(to_json(config)) == config
    with pytest.raises(ValueError, match=r"config\.data\.exclude = 'cup': expected a list of names"):
        from_json(edited("data.exclude", lambda inner, name: inner.__setitem__(name, "cup")))
    with pytest.raises(ValueError, match=r"config\.data\.exclude\[0\] = 3: expected str"):
        from_json(edited("data.exclude", lambda inner, name: inner.__setitem__(name, [3])))


def test_unknown_flags_are_named():
    with pytest.raises(ValueError, match=r"config\.model\.points: unknown flags \['depth'\]"):
        from_json(edited("model.points.depth", lambda inner, name: inner.__setitem__(name, 3)))


def test_what_is_no_config_is_refused():
    with pytest.raises(ValueError, match="expected JSON"):
        from_json("{")
    with pytest.raises(ValueError, match="expected an object of flags"):
        from_json("[]")
    with pytest.raises(ValueError, match=r"config\.data = 5: expected an object of flags"):
        from_json(edited("data", lambda inner, name: inner.__setitem__(name, 5)))


def test_reading_applies_the_rules():
    with pytest.raises(ValueError, match=r"data\.keep = 2"):
        from_json(edited("data.keep", lambda inner, name: inner.__setitem__(name, 2)))


@pytest.mark.parametrize(
    ("flag", "value"), [("optim.batch", "six"), ("optim.batch", True), ("data.root", 5), ("loss.margins", [1.0]), ("name", None)]
)
def test_a_value_of_the_wrong_type_is_named(flag: str, value: object) -> None:
    values = json.loads(to_json(Config()))
    *groups, last = flag.split(".")
    group = values
    for name in groups:
        group = group[name]
    group[last] = value
    with pytest.raises(ValueError, match=flag):
        from_json(json.dumps(values))
