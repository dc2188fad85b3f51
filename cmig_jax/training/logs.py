"""Output of a training: a progress bar, `log.jsonl`, TensorBoard files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from tensorboardX import SummaryWriter
from tqdm import tqdm

from cmig_jax.files import write_text


class Log:
    """Logs of a run at `step` of `total`; lines of later steps, which a continued run will write again, are dropped."""

    def __init__(self, run: Path, step: int, total: int, *, progress: bool) -> None:
        self.path = run / "log.jsonl"
        lines = self.path.read_text().splitlines() if self.path.exists() else []
        kept = [line for line in lines if _step(line) <= step]
        write_text(self.path, "".join(line + "\n" for line in kept))
        self._writer = SummaryWriter(str(run / "tensorboard"), purge_step=step + 1)
        self._bar = tqdm(total=total, initial=step, unit="step", disable=not progress, smoothing=0.05, dynamic_ncols=True)
        self._compiled = step == total
        if not self._compiled:
            self._bar.set_postfix_str("compiling the first step")

    def advance(self, loss: float) -> None:
        """Move the bar by one step."""
        if not self._compiled:
            self._compiled = True
            self._bar.unpause()  # the time to compile does not count as a step
        self._bar.set_postfix(loss=f"{loss:.3f}", refresh=False)
        self._bar.update(1)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Record scalars of a step."""
        with self.path.open("a") as file:
            file.write(json.dumps({"step": step, **values}) + "\n")
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def say(self, text: str) -> None:
        """Print a line above the bar."""
        tqdm.write(text)

    def __enter__(self) -> Log:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._writer.close()
        self._bar.close()


class NoLog:
    """The logs of all processes but the first: nothing."""

    def advance(self, loss: float) -> None: ...
    def write(self, step: int, values: Mapping[str, float]) -> None: ...
    def say(self, text: str) -> None: ...
    def __enter__(self) -> NoLog:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...


def _step(line: str) -> float:
    """Read the step of a log line; infinity for one that was cut off."""
    try:
        return int(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return math.inf
