"""`python -m cmig_jax.experiments list` and `... run NAME... --data DIR`: every table and figure as one command."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cmig_jax.allocator import keep_freed_memory
from cmig_jax.compilation import keep_compiled_programs
from cmig_jax.experiments.figure import plot_rows
from cmig_jax.experiments.plan import Job, Scale, plan
from cmig_jax.experiments.run import Results, collect, run
from cmig_jax.experiments.table import as_json, notes, table
from cmig_jax.training.checkpoint import write_atomically
from cmig_jax.training.loop import Interrupted
from configs.experiments import EXPERIMENTS


@dataclass(frozen=True)
class List:
    """List the experiments and their rows, with what each row changes."""


@dataclass(frozen=True)
class Run:
    """Train what is missing, resume what was interrupted, evaluate, and write a table and a figure for each experiment."""

    names: tyro.conf.Positional[tuple[str, ...]]
    """Experiments, as `list` names them, or `all`."""
    data: str | None = None
    """Folder of the objects to train on (ModelNet40; `shapes` needs none)."""
    source: Literal["modelnet40-hdf5", "meshes", "shapes"] = "modelnet40-hdf5"
    """Layout of `data`."""
    stanford: str | None = None
    """Folder of Stanford models or range scans (`figure7`, `scans`)."""
    sevenscenes: str | None = None
    """Folder of 7-Scenes (`table5`, `fragments`)."""
    scale: Scale = "full"
    """`full`: the paper's size, for an accelerator; `cpu`: the same comparisons for two cores; `toy`: only to see that they run."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trainings; the table shows mean and standard deviation."""
    runs: Path = Path("runs/experiments")
    """Folder of the run folders and results, one folder for each scale in it."""
    limit: int | None = None
    """Evaluate on this many test pairs, evenly spaced, instead of all."""
    only_collect: bool = False
    """Run nothing: write the tables of what is there."""


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, run, and return the exit code: 0, 1 if a row failed, 2 for bad input, 130 when interrupted."""
    commands = Annotated[List, tyro.conf.subcommand("list")] | Annotated[Run, tyro.conf.subcommand("run")]
    command = tyro.cli(commands, prog="python -m cmig_jax.experiments", args=arguments)
    if isinstance(command, List):
        print("\n".join(listing()))
        return 0
    try:
        return run_all(command)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (Interrupted, KeyboardInterrupt):
        print("stopped; the same command continues", file=sys.stderr)
        return 130


def listing() -> list[str]:
    """Describe all experiments."""
    lines = []
    for name, experiment in EXPERIMENTS.items():
        lines += ["", f"{name}: {experiment.about}", f"  all rows: {_flags(experiment.protocol)}"]
        for row in experiment.rows:
            at_test = (f"; at test {_flags(row.test)}" if row.test else "") + (f"; then {row.then}" if row.then else "")
            lines.append(f"  {row.label:26} {row.preset}: {_flags(row.flags)}{at_test}")
    return lines[1:]


def _flags(flags: object) -> str:
    assert isinstance(flags, dict)
    return " ".join(f"{flag}={' '.join(value) if isinstance(value, tuple) else value}" for flag, value in flags.items()) or "as it is"


def run_all(command: Run) -> int:
    """Run the named experiments, one after the other, and return 1 if a row of them failed."""
    names = tuple(EXPERIMENTS) if command.names == ("all",) else command.names
    if unknown := [name for name in names if name not in EXPERIMENTS] or [""] * (not names):
        raise ValueError(f"experiment {unknown[0]!r}: expected all, or some of {', '.join(EXPERIMENTS)}")
    failed = False
    for name in names:
        experiment, jobs = EXPERIMENTS[name], jobs_of(command, name)
        print(f"{name}: {experiment.about}")
        act = collect if command.only_collect else run
        results = act(jobs, with_baselines=experiment.baselines, limit=command.limit)
        write(command.runs / command.scale, name, results)
        failed |= any(outcome.problem.startswith("failed") for outcome in results.outcomes)
    return int(failed)


def jobs_of(command: Run, name: str) -> list[Job]:
    """List the jobs of an experiment as the command line wants them."""
    stanford, scenes = command.stanford, command.sevenscenes
    roots = {
        command.source: command.data,
        "stanford": stanford,
        "stanford-scans": stanford,
        "sevenscenes": scenes,
        "sevenscenes-fragments": scenes,
    }
    runs = command.runs / command.scale
    return plan(EXPERIMENTS[name], scale=command.scale, roots=roots, source=command.source, seeds=command.seeds, runs=runs)


def write(folder: Path, name: str, results: Results) -> None:
    """Print the table; write it as text, Markdown, LaTeX and JSON, and draw it."""
    experiment = EXPERIMENTS[name]
    folder.mkdir(parents=True, exist_ok=True)
    text = table(experiment, results) + "".join(f"{line}\n" for line in notes(results))
    print(text, flush=True)
    write_atomically(folder / f"{name}.txt", text)
    write_atomically(folder / f"{name}.md", table(experiment, results, "markdown"))
    write_atomically(folder / f"{name}.tex", table(experiment, results, "latex"))
    write_atomically(folder / f"{name}.json", json.dumps(as_json(name, experiment, results), indent=1) + "\n")
    if any(outcome.metrics for outcome in results.outcomes):
        plot_rows(name, results, folder / f"{name}.png")


if __name__ == "__main__":
    keep_freed_memory()
    keep_compiled_programs()
    raise SystemExit(main())
