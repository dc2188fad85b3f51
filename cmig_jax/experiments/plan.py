"""A row of an experiment as configs: what to train, what to test on, and the commands that do the same by hand."""

from __future__ import annotations

import functools
import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cmig_jax.config import Config
from cmig_jax.config_json import flat, to_json
from cmig_jax.data.sources import source_of
from cmig_jax.experiments.schema import Catalogue, Experiment, Flags, Row
from cmig_jax.models.networks import config_from_json

ONLY_AT_TEST = ("data.test_categories", "data.tested")
"""Flags that a training does not depend on."""
LONGEST_NAME = 200  # of what a training changes, in characters; file systems allow 255 for a folder


@dataclass(frozen=True)
class Job:
    """One row with one seed.

    Attributes:
        row: the row.
        seed: of weights, training pairs and their order.
        training: config of its network.
        test: config of its test pairs.
        run: its run folder; rows with the same training share it.
        preset: name and config of the preset that the command to train starts from.
        limit: test pairs, evenly spaced, instead of all.
    """

    row: Row
    seed: int
    training: Config
    test: Config
    run: Path
    preset: tuple[str, Config]
    limit: int | None = None

    @property
    def evaluation(self) -> str:
        """The folder of its results inside the run folder: one for each way of testing."""
        name = f"evaluation-{hashlib.sha256(to_json(self.test).encode()).hexdigest()[:8]}"
        return f"{name}-then-{self.row.then.lower()}" if self.row.then else name

    def commands(self) -> tuple[str, str]:
        """Return the commands that train this network, and evaluate it."""
        name, preset = self.preset
        train = ["python", "train.py", name, *command_line(changes(preset, self.training)), "--runs", str(self.run.parent)]
        test = ["python", "evaluate.py", str(self.run), *command_line(changes(self.training, self.test))]
        return shlex.join(train), shlex.join(test + (["--limit", str(self.limit)] if self.limit else []))


def plan(
    experiment: Experiment,
    catalogue: Catalogue,
    *,
    scale: str,
    roots: Mapping[str, str | None],
    source: str,
    seeds: tuple[int, ...],
    runs: Path,
    limit: int | None = None,
) -> list[Job]:
    """List the jobs of an experiment, row by row; a row without a preset has none.

    Args:
        experiment: the table or figure.
        catalogue: presets and scales.
        scale: a name of `catalogue.scales`.
        roots: folder of the raw data by the `folder` of a source.
        source: `data.source` of the experiments that name none.
        seeds: of the trainings.
        runs: folder of the run folders.
        limit: test pairs, evenly spaced, instead of all.

    Raises:
        ValueError: flags that exclude each other, naming them.
    """
    at_scale = catalogue.scales[scale]

    def job(row: Row, name: str, seed: int) -> Job:
        preset = catalogue.presets[name]()
        chosen = with_flags(preset, {"data.source": source} | dict(experiment.protocol) | dict(row.flags))
        scaled = changes(at_scale(preset), at_scale(chosen))  # what a scale sets for all rows is no difference
        differing = {f: v for f, v in changes(preset, chosen).items() if f in scaled and f not in ONLY_AT_TEST}
        run = run_name(name, differing, seed)
        configs = (replace(at_scale(config), name=run, seed=seed) for config in (chosen, with_flags(chosen, row.test)))
        training, test = (_at_root(config, roots) for config in configs)
        nearest = f"{name}-{scale}" if f"{name}-{scale}" in catalogue.presets else name
        return Job(row, seed, training, test, runs / run, (nearest, catalogue.presets[nearest]()), limit)

    return [job(row, row.preset, seed) for row in experiment.rows if row.preset for seed in seeds]


def _at_root(config: Config, roots: Mapping[str, str | None]) -> Config:
    return replace(config, data=replace(config.data, root=roots.get(source_of(config.data).folder or "")))


def run_name(preset: str, flags: Flags, seed: int) -> str:
    """Name a training by what it changes, or by a digest of that where it is too long, so that rows with the same training share it."""

    def text(value: Any) -> str:
        return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)

    changed = "+".join(f"{flag}={text(value)}" for flag, value in sorted(flags.items()))
    if len(changed) > LONGEST_NAME:
        changed = hashlib.sha256(changed.encode()).hexdigest()[:16]
    return "+".join(filter(None, [preset, changed, f"seed={seed}"]))


def with_flags(config: Config, flags: Flags) -> Config:
    """Change flags by their dotted names.

    Raises:
        ValueError: no such flag, a value outside its choices, or flags that exclude each other.
    """
    known, values = flat(config), json.loads(to_json(config))
    for flag, value in flags.items():
        if flag not in known:
            raise ValueError(f"{flag}: expected the name of a flag")
        *groups, last = flag.split(".")
        group = functools.reduce(dict.__getitem__, groups, values)
        group[last] = list(value) if isinstance(value, tuple) else value
    return config_from_json(json.dumps(values))


def changes(old: Config, new: Config) -> dict[str, Any]:
    """Return the flags in which `new` differs from `old`, with their new values; the name and the seed included."""
    before = flat(old)
    return {flag: value for flag, value in flat(new).items() if flag not in before or value != before[flag]}


def command_line(flags: Flags) -> Iterator[str]:
    """Write flags as `train.py` takes them."""
    for flag, value in flags.items():
        name = flag.replace("_", "-")
        if isinstance(value, bool):
            group, _, last = name.rpartition(".")
            yield f"--{group}.{'' if value else 'no-'}{last}"
        else:
            yield f"--{name}"
            yield from map(str, value if isinstance(value, tuple) else (value,))
