"""Experiments as configs: every row is one, and its commands make the same ones."""

import shlex
from pathlib import Path

import pytest
import tyro

from cmig_jax.commands import train
from cmig_jax.config import Config
from cmig_jax.experiments.plan import changes, command_line, plan, run_name, with_flags
from configs import PRESETS
from configs.catalogue import catalogue
from configs.experiments import AT_TEST, CORRECTIONS, EXPERIMENTS

ROOTS = dict.fromkeys(("data", "stanford", "sevenscenes"), "DIR")


def jobs(name, scale="cpu", seeds=(0,)):
    return plan(EXPERIMENTS[name], catalogue(), scale=scale, roots=ROOTS, source="modelnet40-hdf5", seeds=seeds, runs=Path("runs"))


def test_every_table_and_figure_of_the_paper_is_there():
    assert {f"table{i}" for i in range(1, 9)} | {"figure7", "figure8", "figure9"} <= set(EXPERIMENTS)
    assert [row.label for row in EXPERIMENTS["table7"].rows] == ["n = 2", "n = 3", "n = 4", "n = 5"]
    assert [row.quoted.rmse_r_deg for row in EXPERIMENTS["table6"].rows] == [3.565, 3.106, 2.537, 1.708, 1.472]


SHRUNK = {"full": (), "short": ("optim.epochs",), "cpu": ("data.points", "optim.", "model.keypoints.count")}
"""Flags of rows that a scale sets for all."""
SHRUNK["toy"] = (*SHRUNK["cpu"], "data.shapes", "views.size", "model.patches", "model.layers", "model.dim")


@pytest.mark.parametrize("scale", SHRUNK)
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_row_is_a_config_at_every_scale(name, scale):
    found = jobs(name, scale)
    assert len(found) == sum(row.preset is not None for row in EXPERIMENTS[name].rows)
    assert all((row.preset is None) == bool(row.absent) for row in EXPERIMENTS[name].rows)
    for job in found:
        flags = dict(EXPERIMENTS[name].protocol) | dict(job.row.flags)
        kept = {flag: value for flag, value in flags.items() if not flag.startswith(SHRUNK[scale])}
        assert changes(with_flags(job.training, kept), job.training) == {}
        assert len(job.run.name) <= 255
        assert changes(job.training, job.test).keys() <= set(job.row.test) | {"data.root"}


def test_at_full_scale_a_row_changes_what_it_names_and_nothing_else():
    for name, experiment in EXPERIMENTS.items():
        for job in jobs(name, "full"):
            named = set(experiment.protocol) | set(job.row.flags) | {"name", "data.root"}
            assert changes(PRESETS[job.row.preset](), job.training).keys() <= named


@pytest.mark.parametrize("scale", ["full", "cpu"])
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_the_printed_command_trains_the_same_config(name, scale):
    for job in jobs(name, scale, seeds=(3,)):
        words = shlex.split(job.commands()[0])
        assert words[:2] == ["python", "train.py"]
        command = train.parse(words[2:], "train.py", catalogue)
        assert command.config == job.training
        assert command.runs / command.config.name == job.run


def test_rows_share_a_training_exactly_if_they_train_alike():
    found = [job for name in EXPERIMENTS for job in jobs(name, seeds=(0, 1))]
    trainings = {}
    for job in found:
        alike = with_flags(job.training, {"name": "any", "data.test_categories": "all"})
        assert trainings.setdefault(job.run, alike) == alike
    assert len(set(map(repr, trainings.values()))) == len(trainings)
    assert len(trainings) < len(found)


def test_no_row_asks_a_recording_for_renders_of_a_complete_object():
    tests = [job.test for name in EXPERIMENTS for job in jobs(name, "full")]
    recorded = [test for test in tests if test.data.source in ("stanford-scans", "sevenscenes-fragments")]
    assert recorded
    assert {test.views.of for test in recorded} == {"both"}


def test_rows_that_are_tested_differently_have_different_results():
    real, shuffled, zero = (job for job in jobs("images")[:3])
    assert real.run == shuffled.run == zero.run
    assert len({real.evaluation, shuffled.evaluation, zero.evaluation}) == 3
    assert jobs("corrections")[0].evaluation == real.evaluation
    alone, refined = (next(job for job in jobs("scans") if job.row.label == label) for label in ("corrected", "corrected, then ICP"))
    assert (alone.run, alone.test) == (refined.run, refined.test)
    assert alone.evaluation != refined.evaluation


def test_corrected_is_released_with_the_corrections_that_help():
    flags = dict(AT_TEST)
    for name in ("random keypoints", "view tokens", "observed views"):
        flags |= CORRECTIONS[name]
    left = changes(with_flags(PRESETS["released"](), flags), PRESETS["corrected"]()).keys() - {"name"}
    assert left == {"model.keypoints.score_from", "model.keypoints.activation"}, "which random keypoints do not read"


def test_a_flag_that_is_none_is_an_error():
    for flag in ("model.matching.iteration", "model.matching", "speed", "data.points.k"):
        with pytest.raises(ValueError, match="expected the name of a flag"):
            with_flags(PRESETS["paper"](), {flag: 3})
    with pytest.raises(ValueError, match=r"config\.views\.of = 'all': expected one of"):
        with_flags(PRESETS["paper"](), {"views.of": "all"})


def test_names_and_command_lines():
    flags = {"model.keypoints.score_from": "other", "data.exclude": ("cup", "vase")}
    assert run_name("paper", flags, 2) == "paper+data.exclude=cup,vase+model.keypoints.score_from=other+seed=2"
    assert list(command_line(flags)) == ["--model.keypoints.score-from", "other", "--data.exclude", "cup", "vase"]
    preset = PRESETS["paper"]()
    parsed = tyro.cli(Config, default=preset, args=list(command_line(flags)), config=(tyro.conf.ConsolidateSubcommandArgs,))
    assert changes(preset, parsed) == flags
