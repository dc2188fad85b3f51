"""`train.py` and `cmig train`, as they are typed."""

import json
import re

import pytest

from cmig_jax.config_json import flat
from cmig_jax.inference.run_folder import read_config
from configs import PRESETS


def explanation(text, flag):
    """Return what `--help` says of a flag after its kind of value."""
    found = re.search(rf"--{re.escape(flag)}(?:, --\S+)? (.*?)\(default", re.sub(r"[│\s]+", " ", text))
    return [] if found is None else found[1].split()[1:]


def assert_one_line(done):
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_help_lists_the_presets_with_their_meaning(main):
    overview = main("train", "--help")
    text = re.sub(r"[│\s]+", " ", overview.stdout)
    assert overview.returncode == 0
    for name, preset in PRESETS.items():
        assert f"• {name} " in text
        assert preset.__doc__ is not None
        assert preset.__doc__ in text


def test_help_says_what_every_flag_means(main):
    description = main("train", "quickstart", "--help")
    assert description.returncode == 0
    flags = [flag.replace("_", "-") for flag in flat(PRESETS["quickstart"]())]
    assert len(flags) > 50
    unexplained = [flag for flag in [*flags, "runs", "devices"] if len(explanation(description.stdout, flag)) < 3]
    assert unexplained == []
    assert "--resume" in description.stdout


def test_a_wrong_flag_names_the_nearest(main):
    done = main("train", "quickstart", "--optim.batsh", 4)
    assert done.returncode == 2
    assert "--optim.batsh" in done.stderr
    assert "--optim.batch" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_wrong_value_names_the_choices(main):
    done = main("train", "quickstart", "--data.crop", "half")
    assert done.returncode == 2
    for word in ("half", "--data.crop", "shared", "independent", "none"):
        assert word in done.stderr


def test_a_wrong_preset_names_the_presets(main):
    done = main("train", "quikstart")
    assert done.returncode == 2
    assert all(name in done.stderr for name in PRESETS)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ("--model.fusion.points", "none", "--model.fusion.image", "transformer"),
            "model.fusion.image = transformer with model.fusion.points = none",
        ),
        (("--views.count", 12), "views.count = 12: expected 6 for views.layout=axes"),
        (("--optim.batch", 1), "optim.batch = 1: expected at least 2 pairs for this network and its losses"),
    ],
)
def test_flags_that_exclude_each_other_are_one_line_of_error(main, tmp_path, flags, message):
    done = main("train", "quickstart", *flags, "--runs", tmp_path)
    assert_one_line(done)
    assert message in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_bad_data_root_is_one_line_of_error(command_line, tmp_path):
    done = command_line("train.py", "paper", "--data.root", tmp_path / "nowhere", "--runs", tmp_path / "runs")
    assert_one_line(done)
    assert f"{tmp_path}/nowhere" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_run_says_how_it_goes_and_leaves_its_folder(trained, tiny):
    run, done = trained
    assert done.returncode == 0, done.stderr
    assert re.search(r"epoch 4: validation RMSE\(R\) \d+\.\d+ deg, recall \d\.\d\d", done.stdout)
    assert "8/8" in done.stderr
    assert "loss=" in done.stderr
    assert not re.search("warn|error|traceback", done.stderr, re.IGNORECASE)
    assert {"config.json", "log.jsonl", "checkpoints", "tensorboard"} <= {path.name for path in run.iterdir()}
    assert read_config(run) == tiny
    measured = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert measured[-1]["step"] == 8
    assert "val_rmse_r_deg" in measured[-1]


def test_a_folder_that_holds_a_run_needs_resume(main, flags, trained):
    run, _ = trained
    done = main("train", "quickstart", *flags(read_config(run)), "--runs", run.parent)
    assert_one_line(done)
    assert "--resume" in done.stderr
