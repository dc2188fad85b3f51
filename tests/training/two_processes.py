"""One of two processes that train, are interrupted in the second one alone, and continue: started by `test_distributed.py`.

python two_processes.py PROCESS PORT RUN COPY [arguments of `cmig train`]
"""

import itertools
import shutil
import signal
import sys
from pathlib import Path

from cmig_jax import cli
from cmig_jax.training import loop

INTERRUPTED_AT = 2  # the vote of a step is known after the next one, which is then the last


def main(process: int, port: str, run: Path, copy: Path, flags: list[str]) -> list[int]:
    """Return the exit codes of the interrupted run and of the one that continued it; `copy` holds the folder between them."""
    steps, to_device = itertools.count(1), loop.to_device
    make_step, made = loop.make_step, []

    def interrupted_to_device(*arguments):
        if process == 1 and next(steps) == INTERRUPTED_AT:
            signal.raise_signal(signal.SIGINT)
        return to_device(*arguments)

    def make_step_once(*arguments):
        if not made:
            made.append(make_step(*arguments))
        return made[0]

    loop.LOG_EVERY = 1
    loop.make_step = make_step_once
    loop.to_device = interrupted_to_device
    meeting = ["--distributed", "--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process", str(process)]
    codes = [cli.main(["train", *flags, *meeting], cli.installed_catalogue)]
    if process == 0:
        shutil.copytree(run, copy)
    return [*codes, cli.main(["train", *flags, "--resume"], cli.installed_catalogue)]  # the processes have met already


if __name__ == "__main__":
    print("exit codes", main(int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]), sys.argv[5:]))
