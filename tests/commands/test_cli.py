"""`cmig` itself: what belongs to no command."""

import subprocess
import sys

from cmig_jax import cli
from configs.catalogue import catalogue


def test_without_a_command_all_commands_are_listed(capsys):
    assert cli.main([], catalogue) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line.startswith("  ")]
    assert listed == ["register", "train", "evaluate", "prepare", "export", "experiments", "parity", "bench"]


def test_an_unknown_command_is_an_error(capsys):
    assert cli.main(["trian"], catalogue) == 2
    assert capsys.readouterr().err.startswith("error: trian: expected a command: register, train")


def test_a_reader_that_stops_early_sees_no_message():
    lines = "import sys; from cmig_jax import cli; sys.exit(cli.main(['bench', '--help'], cli.installed_catalogue))"
    process = subprocess.Popen([sys.executable, "-u", "-c", lines], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    process.stdout.close()
    _, message = process.communicate(timeout=60)
    assert (process.returncode, message) == (1, b"")
