"""`train.py`, as it is typed."""

import dataclasses
import json
import re

import pytest

from cmig_jax.config import Config
from cmig_jax.training.checkpoint import read_config
from configs import PRESETS


def flags_of(kind, prefix=""):
    """List every flag of a config, as it is typed."""
    for field in dataclasses.fields(kind):
        if dataclasses.is_dataclass(field.default_factory):
            yield from flags_of(field.default_factory, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}".replace("_", "-")


def explanation(text, flag):
    """Return what `--help` says of a flag after its kind of value."""
    found = re.search(rf"--{re.escape(flag)} (.*?)\(default", re.sub(r"[│\s]+", " ", text))
    return [] if found is None else found[1].split()[1:]


def assert_one_line(finished):
    assert finished.returncode == 2
    assert finished.stdout == ""
    assert finished.stderr.startswith("error: ")
    assert finished.stderr.count("\n") == 1


def test_help_lists_the_presets_with_their_meaning(main):
    overview = main("train.py", "--help")
    text = re.sub(r"[│\s]+", " ", overview.stdout)
    assert overview.returncode == 0
    for name, preset in PRESETS.items():
        assert f"• {name} " in text
        assert preset.__doc__ is not None
        assert preset.__doc__ in text


def test_help_says_what_every_flag_means(main):
    description = main("train.py", "quickstart", "--help")
    assert description.returncode == 0
    flags = list(flags_of(Config))
    assert len(flags) > 50
    unexplained = [flag for flag in [*flags, "runs", "devices"] if len(explanation(description.stdout, flag)) < 3]
    assert unexplained == []
    assert "--resume" in description.stdout


def test_a_wrong_flag_names_the_nearest(main):
    finished = main("train.py", "quickstart", "--optim.batsh", 4)
    assert finished.returncode == 2
    assert "--optim.batsh" in finished.stderr
    assert "--optim.batch" in finished.stderr
    assert "Traceback" not in finished.stderr


def test_a_wrong_value_names_the_choices(main):
    finished = main("train.py", "quickstart", "--data.crop", "half")
    assert finished.returncode == 2
    for word in ("half", "--data.crop", "shared", "independent", "none"):
        assert word in finished.stderr


def test_a_wrong_preset_names_the_presets(main):
    finished = main("train.py", "quikstart")
    assert finished.returncode == 2
    assert all(name in finished.stderr for name in PRESETS)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ("--model.fusion.points", "none", "--model.fusion.image", "transformer"),
            "model.fusion.image = transformer with model.fusion.points = none",
        ),
        (("--views.count", 12), "views.count = 12: expected 6 for views.layout=axes"),
        (("--optim.batch", 1), "optim.batch = 1 with loss.cross_modal = nt-xent"),
    ],
)
def test_flags_that_exclude_each_other_are_one_line_of_error(main, tmp_path, flags, message):
    finished = main("train.py", "quickstart", *flags, "--runs", tmp_path)
    assert_one_line(finished)
    assert message in finished.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_bad_data_root_is_one_line_of_error(command_line, tmp_path):
    finished = command_line("train.py", "paper", "--data.root", tmp_path / "nowhere", "--runs", tmp_path / "runs")
    assert_one_line(finished)
    assert f"{tmp_path}/nowhere" in finished.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_run_says_how_it_goes_and_leaves_its_folder(trained, tiny):
    run, finished = trained
    assert finished.returncode == 0, finished.stderr
    assert re.search(r"epoch 4: validation RMSE\(R\) \d+\.\d+ deg, recall \d\.\d\d", finished.stdout)
    assert "8/8" in finished.stderr
    assert "loss=" in finished.stderr
    assert not re.search("warn|error|traceback", finished.stderr, re.IGNORECASE)
    assert {"config.json", "log.jsonl", "checkpoints", "tensorboard"} <= {path.name for path in run.iterdir()}
    assert read_config(run) == tiny
    measured = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert measured[-1]["step"] == 8
    assert "val_rmse_r_deg" in measured[-1]


def test_a_folder_that_holds_a_run_needs_resume(main, flags, trained):
    run, _ = trained
    finished = main("train.py", "quickstart", *flags(read_config(run)), "--runs", run.parent)
    assert_one_line(finished)
    assert "--resume" in finished.stderr
