"""Configs: the rules of each group, JSON there and back, the layout from before networks had names, and imports without JAX."""

import dataclasses
import json
import math
import re
import subprocess
import sys

import pytest

import cmig_jax.config
from cmig_jax.config import ComputeConfig, Config, DataConfig, OptimConfig, ViewsConfig
from cmig_jax.config_json import differences, flat, to_json
from cmig_jax.models.cmignet import flags as cmignet
from cmig_jax.models.networks import config_from_json
from cmig_jax.models.patches.flags import PatchFlags

PAPER = Config(name="paper", model=cmignet.CMIGNetFlags())
REFUSED_BY_GROUP = [
    ("", {"name": ["", "../elsewhere", "/anywhere"], "seed": [-1]}),
    ("data.", {"points": [0], "keep": [0.0, 1.5, -0.1], "validation": [0.0, 1.0], "shapes": [3], "test_seed": [-1], "workers": [-1]}),
    ("data.", {"noise_std": [-0.01, math.inf], "noise_clip": [-0.05], "max_angle_deg": [-1.0, 181.0], "max_translation": [-0.5, math.inf]}),
    ("data.", {"max_twist": [-0.1, math.inf], "keep_least": [-0.1, 0.01, 0.8]}),
    ("views.", {"count": [12, 0], "size": [7]}),
    ("model.points.", {"k": [0], "widths": [(), (64, 0)], "dim": [2], "local_widths": [(), (12,)]}),
    ("model.image.", {"widths": [(64, 128, 256, 511)], "blocks": [(2, 2, 2)]}),
    ("model.fusion.", {"heads": [0, 3], "feed_forward": [0]}),
    ("model.keypoints.", {"count": [1], "test_count": [-1, 1]}),
    ("model.matching.", {"iterations": [0], "repeats": [-1], "feature_widths": [()], "coordinate_widths": [(0,)]}),
    ("model.loss.", {"overlap_threshold": [0.0], "match_threshold": [-0.05], "margins": [(-1.0, 3.0)], "temperature": [0.0]}),
    ("optim.", {"learning_rate": [0.0], "weight_decay": [-1e-3], "decay": [0.0, 2.0], "clip_norm": [-1.0]}),
    ("optim.", {"milestones": [(0,), (50, 50), (75, 50)], "epochs": [0], "batch": [0, 1], "validate_every": [0]}),
    ("compute.", {"rows": [-1]}),
]
REFUSED = {group + name: values for group, flags in REFUSED_BY_GROUP for name, values in flags.items()}

# A config that the version before `models/` wrote: losses at the top level, on and off, no name of a network.
OLD_LAYOUT = """{"name": "old", "seed": 3,
"data": {"source": "shapes", "root": null, "prepared": null, "categories": "all", "test_categories": "all", "exclude": ["cup"],
"shapes": 40, "points": 512, "sampling": "twice", "keep": 0.75, "crop": "independent", "noise_std": 0.01, "noise_clip": 0.05,
"max_angle_deg": 45.0, "turn": "either", "max_translation": 0.5, "validation": 0.1, "test_seed": 1234, "workers": 0},
"views": {"of": "both", "count": 6, "size": 32, "layout": "axes", "shown": "real"},
"model": {"points": {"k": 16, "widths": [32, 64], "dim": 128}, "image": {"widths": [16, 128], "blocks": [1, 1]},
"fusion": {"points": "transformer", "image": "views", "heads": 4, "feed_forward": 256},
"keypoints": {"select": "predicted", "count": 64, "test_count": 384, "score_from": "own", "activation": "linear"},
"matching": {"head": "cmignet", "iterations": 3, "repeats": 5, "correspondence": "soft", "feature_widths": [64, 32],
"coordinate_widths": [32, 32, 32]}, "pose": {"centroid": "unweighted", "gradient": "stopped"}},
"loss": {"overlap": "off", "overlap_mean": "all", "margins": [1.0, 3.0], "overlap_threshold": 0.01, "match_threshold": 0.05,
"cross_modal": "nt-xent", "temperature": 0.1, "credibility_label": "distance", "match_mean": "positive"},
"optim": {"learning_rate": 0.002, "weight_decay": 0.001, "schedule": "cosine", "milestones": [50, 75], "decay": 0.5, "epochs": 100,
"batch": 6, "clip_norm": 5.0, "validate_every": 1}, "compute": {"precision": "float32", "recompute": "on", "rows": 512}}"""


def changed(config, flag, value):
    """Replace one flag, named by its path."""
    name, _, rest = flag.partition(".")
    return dataclasses.replace(config, **{name: changed(getattr(config, name), rest, value) if rest else value})


def edited(flag, edit, text=None):
    """Write a config (by default the paper's) as JSON with the object that holds `flag` edited."""
    values = json.loads(text or to_json(PAPER))
    inner, path = values, flag.split(".")
    for name in path[:-1]:
        inner = inner[name]
    edit(inner, path[-1])
    return json.dumps(values)


def with_value(flag, value, text=None):
    return edited(flag, lambda inner, name: inner.__setitem__(name, value), text)


def test_json_round_trip_keeps_every_flag():
    config = dataclasses.replace(PAPER, name="mine", seed=7, views=ViewsConfig(count=12, layout="ring"))
    config = changed(changed(config, "model.fusion.image", "views"), "data.noise_std", 0.0)
    config = changed(changed(config, "data.exclude", ("cup", "vase")), "compute.recompute", True)
    assert config_from_json(to_json(config)) == config != PAPER
    assert json.loads(to_json(config))["network"] == "cmignet"


def test_sequences_come_back_as_tuples_so_that_configs_are_hashable():
    config = config_from_json(to_json(PAPER))
    assert config.model.points.widths == (64, 64, 64, 128)
    assert hash(config) == hash(PAPER)


@pytest.mark.parametrize(("flag", "value"), [(flag, value) for flag, values in REFUSED.items() for value in values])
def test_a_refused_value_is_named_with_its_flag_and_what_was_expected(flag, value):
    with pytest.raises(ValueError, match=re.escape(f"{flag} = {value}") + ".*: expected .+"):
        changed(PAPER, flag, value)


def test_every_rule_is_tested_above(monkeypatch):
    ruled = set()
    for module in (cmig_jax.config, cmignet):
        monkeypatch.setattr(module, "check", lambda rules: ruled.update(name.split(" = ")[0] for name, _, _ in rules))
    Config(name="paper", model=cmignet.CMIGNetFlags())
    apart = {
        "model.fusion.image",
        "data.crop",
        "data.frame",
        "views.of",
        "model.matching.head",
        *(f"model.keypoints.{x}" for x in ("select", "activation", "score_from")),
    }
    assert ruled == set(REFUSED) | apart


def test_tied_image_fusion_needs_the_transformer_whose_weights_it_shares():
    with pytest.raises(ValueError, match=r"model\.fusion\.image = transformer with model\.fusion\.points = none"):
        changed(PAPER, "model.fusion", cmignet.FusionFlags(points="none", image="transformer"))


@pytest.mark.parametrize(("flag", "value"), [("select", "random"), ("activation", "sigmoid"), ("score_from", "other")])
def test_overlap_scores_are_predicted_logits_of_the_cloud_s_own_points(flag, value):
    with pytest.raises(ValueError, match=rf"model\.keypoints\.{flag} = {value} with model\.keypoints\.target = overlap: expected"):
        changed(PAPER, "model.keypoints", cmignet.KeypointsFlags(target="overlap", **{flag: value}))


@pytest.mark.parametrize(("group", "flag", "value"), [("keypoints", "target", "overlap"), ("matching", "correspondence", "sinkhorn")])
def test_a_regressed_pose_has_no_matching_to_change(group, flag, value):
    regressed = dataclasses.replace(PAPER.model, matching=cmignet.MatchingFlags(head="pcrnet"))
    with pytest.raises(ValueError, match=rf"model\.matching\.head = pcrnet with .*{flag} = {value}.*: expected another head"):
        dataclasses.replace(regressed, **{group: dataclasses.replace(getattr(regressed, group), **{flag: value})})


@pytest.mark.parametrize("frame", ["any", "half"])
def test_views_of_objects_are_in_the_objects_frames(frame):
    with pytest.raises(ValueError, match=rf"data\.frame = {frame} with views\.of = object: expected views of the observed clouds"):
        changed(PAPER, "data.frame", frame)
    observed = changed(changed(PAPER, "views.of", "both"), "data.frame", frame)
    assert observed.data.as_tested.frame == {"any": "any", "half": "object"}[frame]


@pytest.mark.parametrize("image", ["pixels", "views"])
def test_where_points_fall_is_known_in_views_of_both_clouds_along_the_axes(image):
    views = ViewsConfig(of="both", count=6, layout="axes")
    config = Config(name="mine", model=PatchFlags(image=image), views=views)
    for other in (dataclasses.replace(views, of="source"), dataclasses.replace(views, layout="ring")):
        with pytest.raises(ValueError, match=rf"views\.of = {other.of}, views\.layout = {other.layout}: expected both, and axes"):
            dataclasses.replace(config, views=other)
    assert dataclasses.replace(config, model=PatchFlags(), views=ViewsConfig()).model.needs.views is False


def test_a_share_is_drawn_for_crops_of_both_clouds():
    for crop in ("source", "none"):
        with pytest.raises(ValueError, match=rf"data\.keep_least = 0\.4 with data\.crop = {crop}: expected a crop of both clouds"):
            DataConfig(keep_least=0.4, crop=crop)


def test_rules_hold_only_where_the_flag_is_used():
    no_views = changed(changed(PAPER, "model.loss.cross_modal", "off"), "model.fusion.image", "none")
    assert changed(no_views, "optim.batch", 1).optim.batch == 1
    assert changed(no_views, "model.image.widths", (8, 8, 8, 8)).model.points.dim == 512
    for layout, count in (("ring", 7), ("axes", 6), ("dodecahedron", 20)):
        assert changed(PAPER, "views", ViewsConfig(layout=layout, count=count)).views.sets == 1


def test_derived_numbers():
    assert [data.cropped_points for data in (DataConfig(), DataConfig(crop="none"), DataConfig(points=10, keep=0.7))] == [768, 1024, 7]
    assert [DataConfig(crop=crop).target_points for crop in ("shared", "source", "none")] == [768, 1024, 1024]
    assert [ViewsConfig(of=of).sets for of in ("object", "source", "target", "both")] == [1, 1, 1, 2]
    assert [ComputeConfig(precision=precision).dtype for precision in ("float32", "bfloat16")] == [None, "bfloat16"]


CHOICES = [("data.crop", "half"), ("model.matching.head", 3), ("model.loss.cross_modal", True), ("views.of", None)]


@pytest.mark.parametrize(("flag", "value"), CHOICES)
def test_a_value_outside_its_choices_is_named(flag, value):
    with pytest.raises(ValueError, match=re.escape(f"config.{flag} = {value!r}: expected one of ")):
        config_from_json(with_value(flag, value))


WRONG_TYPES = [("optim.batch", "six"), ("optim.batch", True), ("data.root", 5), ("data.exclude", "cup"), ("data.exclude", [3])]
WRONG_TYPES += [("model.loss.margins", [1.0]), ("model.loss.overlap", "on"), ("compute.recompute", 1), ("name", None)]
WRONG_TYPES += [("model", [1]), ("data", 5)]


@pytest.mark.parametrize(("flag", "value"), WRONG_TYPES)
def test_a_value_of_the_wrong_type_is_named(flag, value):
    with pytest.raises(ValueError, match=rf"^config\.{re.escape(flag)}(\[0\])? = .+: expected "):
        config_from_json(with_value(flag, value))


@pytest.mark.parametrize("flag", ["optim.batch", "data.exclude", "views.shown", "views"])
def test_a_flag_that_a_file_lacks_has_its_default(flag):
    assert config_from_json(edited(flag, lambda inner, name: inner.pop(name))) == PAPER


def test_unknown_and_missing_flags_and_networks_are_named():
    with pytest.raises(ValueError, match=r"config\.model\.points: unknown flags \['depth'\]"):
        config_from_json(with_value("model.points.depth", 3))
    with pytest.raises(ValueError, match=r"config: missing \['name'\]"):
        config_from_json(edited("name", lambda inner, name: inner.pop(name)))
    for network in ("pointer", None, ["cmignet"]):
        with pytest.raises(ValueError, match=re.escape(f"config.network = {network!r}: expected one of cmignet")):
            config_from_json(with_value("network", network))


def test_text_that_is_not_a_config_is_refused_and_rules_apply():
    for text, message in (("{", "expected JSON"), ("[]", "expected an object of flags"), (with_value("data.keep", 2), r"data\.keep = 2")):
        with pytest.raises(ValueError, match=message):
            config_from_json(text)


def test_the_layout_from_before_networks_had_names_is_read_as_the_same_settings():
    model = cmignet.CMIGNetFlags(
        points=cmignet.PointsFlags(k=16, widths=(32, 64), dim=128),
        image=cmignet.ImageFlags(widths=(16, 128), blocks=(1, 1)),
        fusion=cmignet.FusionFlags(image="views", feed_forward=256),
        keypoints=cmignet.KeypointsFlags(count=64, test_count=384),
        matching=cmignet.MatchingFlags(repeats=5, correspondence="soft", feature_widths=(64, 32)),
        pose=cmignet.PoseFlags(centroid="unweighted"),
        loss=cmignet.LossFlags(overlap=False, margins=(1.0, 3.0), cross_modal="nt-xent", match_mean="positive"),
    )
    data = DataConfig(source="shapes", points=512, sampling="twice", crop="independent", turn="either", exclude=("cup",))
    views, compute = ViewsConfig(of="both", count=6, size=32, layout="axes"), ComputeConfig(recompute=True, rows=512)
    optim = OptimConfig(learning_rate=2e-3, schedule="cosine", clip_norm=5.0)
    assert config_from_json(OLD_LAYOUT) == Config(name="old", seed=3, model=model, data=data, views=views, optim=optim, compute=compute)
    opposite = with_value("loss.overlap", "on", with_value("compute.recompute", "off", OLD_LAYOUT))
    assert config_from_json(opposite).model.loss.overlap is True
    assert config_from_json(opposite).compute.recompute is False
    assert config_from_json('{"name": "paper"}') == PAPER


OLD_ERRORS = [("loss.overlap", "maybe"), ("compute.recompute", "yes"), ("loss", 5), ("compute", 5), ("model", 5)]


@pytest.mark.parametrize(("flag", "value"), OLD_ERRORS)
def test_errors_in_the_old_layout_are_named(flag, value):
    with pytest.raises(ValueError, match=rf"^config\.(model\.)?{re.escape(flag)} = {value!r}: expected "):
        config_from_json(with_value(flag, value, OLD_LAYOUT))


def test_flags_by_dotted_name_and_differences():
    other = changed(changed(PAPER, "model.points.k", 16), "data.exclude", ("cup",))
    assert flat(other)["model.points.k"] == 16
    assert differences(PAPER, PAPER) == []
    assert sorted(differences(PAPER, other)) == ["data.exclude: () -> ('cup',)", "model.points.k: 20 -> 16"]


def test_configs_and_flags_are_read_without_jax():
    imports = "import sys, cmig_jax.config, cmig_jax.config_json, cmig_jax.models.cmignet.flags, configs, configs.catalogue"
    check = "sys.exit(', '.join(sorted({'jax', 'jaxlib', 'flax'} & set(sys.modules))) or 0)"
    found = subprocess.run([sys.executable, "-c", f"{imports}; {check}"], capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
