"""A row of an experiment as configs: what to train, what to test on, and the commands that do the same by hand."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from cmig_jax.config import Config, from_json, to_json
from configs import PRESETS
from configs.experiments import Experiment, Flags, Row
from configs.scale import at_cpu_scale, at_toy_scale

Scale = Literal["full", "cpu", "toy"]
SCALES: dict[Scale, Callable[[Config], Config]] = {"full": lambda config: config, "cpu": at_cpu_scale, "toy": at_toy_scale}
ABOUT_THE_TEST = ("data.test_categories",)
"""Flags that a training does not depend on."""


@dataclass(frozen=True)
class Job:
    """One row with one seed.

    Attributes:
        row: the row.
        seed: of weights, training pairs and their order.
        training: config of its network.
        test: config whose test pairs it is judged on.
        run: its run folder; rows that train alike share it.
        preset: the preset that the command to train starts from.
    """

    row: Row
    seed: int
    training: Config
    test: Config
    run: Path
    preset: str

    @property
    def evaluation(self) -> str:
        """The folder of its results inside the run folder: one for each way of testing."""
        name = f"evaluation-{hashlib.sha256(to_json(self.test).encode()).hexdigest()[:8]}"
        return f"{name}-then-{self.row.then.lower()}" if self.row.then else name

    def commands(self) -> tuple[str, str]:
        """Return what to type to train this network, and to evaluate it."""
        changed = changes(PRESETS[self.preset](), self.training)
        train = ["python", "train.py", self.preset, *command_line(changed), "--runs", str(self.run.parent)]
        test = changes(self.training, self.test)
        return shlex.join(train), shlex.join(["python", "evaluate.py", str(self.run), *command_line(test)])


def plan(
    experiment: Experiment, *, scale: Scale, roots: Mapping[str, str | None], source: str, seeds: tuple[int, ...], runs: Path
) -> list[Job]:
    """List the jobs of an experiment, row by row.

    Args:
        experiment: the table or figure.
        scale: `full` is the preset's own size, `cpu` the same comparison for two cores, `toy` a test of the machinery.
        roots: folder of the raw data for each `data.source`.
        source: `data.source` of the experiments that name none.
        seeds: of the trainings.
        runs: folder of the run folders.

    Raises:
        ValueError: flags that exclude each other, naming them.
    """
    return [_job(experiment, row, seed, scale, roots, source, runs) for row in experiment.rows for seed in seeds]


def _job(experiment: Experiment, row: Row, seed: int, scale: Scale, roots: Mapping[str, str | None], source: str, runs: Path) -> Job:
    preset = PRESETS[row.preset]()
    chosen = with_flags(preset, {"data.source": source} | dict(experiment.protocol) | dict(row.flags))
    scaled = changes(SCALES[scale](preset), SCALES[scale](chosen))  # what a scale sets for all is no difference
    differing = {f: v for f, v in changes(preset, chosen).items() if f in scaled and f not in ABOUT_THE_TEST}
    name = run_name(row.preset, differing, seed)
    training, test = (
        _at_root(replace(SCALES[scale](config), name=name, seed=seed), roots) for config in (chosen, with_flags(chosen, row.test))
    )
    nearest = f"{row.preset}-cpu" if scale == "cpu" else row.preset
    return Job(row, seed, training, test, runs / name, nearest)


def _at_root(config: Config, roots: Mapping[str, str | None]) -> Config:
    return replace(config, data=replace(config.data, root=roots.get(config.data.source)))


def run_name(preset: str, flags: Flags, seed: int) -> str:
    """Name a training by what it changes, so that rows with the same training share it."""

    def text(value: Any) -> str:
        return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)

    return "+".join([preset, *(f"{flag}={text(value)}" for flag, value in sorted(flags.items())), f"seed={seed}"])


def with_flags(config: Config, flags: Flags) -> Config:
    """Change flags, named as on the command line with dots and underscores.

    Raises:
        ValueError: no such flag, a value outside its choices, or flags that exclude each other.
    """
    known = dict(_flat(dataclasses.asdict(config)))
    values = json.loads(to_json(config))
    for flag, value in flags.items():
        if flag not in known:
            raise ValueError(f"{flag}: expected the name of a flag")
        *groups, last = flag.split(".")
        group = functools.reduce(dict.__getitem__, groups, values)
        group[last] = list(value) if isinstance(value, tuple) else value
    return from_json(json.dumps(values))


def changes(old: Config, new: Config) -> dict[str, Any]:
    """Return the flags in which `new` differs from `old`, with their values there; the name and the seed included."""
    before, after = dict(_flat(dataclasses.asdict(old))), dict(_flat(dataclasses.asdict(new)))
    return {flag: value for flag, value in after.items() if value != before[flag]}


def command_line(flags: Flags) -> Iterator[str]:
    """Write flags as `train.py` takes them."""
    for flag, value in flags.items():
        yield f"--{flag.replace('_', '-')}"
        yield from map(str, value if isinstance(value, tuple) else (value,))


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
