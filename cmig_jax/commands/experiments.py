"""`cmig experiments list`, and `cmig experiments run NAME... --data DIR`: every table and figure as one command."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cmig_jax.commands import Stopped
from cmig_jax.commands.parsing import parse_flags
from cmig_jax.experiments.schema import Catalogue, Experiment, Flags

if TYPE_CHECKING:
    from cmig_jax.experiments.plan import Job
    from cmig_jax.experiments.run import Results


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
    source: str = "modelnet40-hdf5"
    """`data.source` of the experiments that name none: the layout of `data`."""
    stanford: str | None = None
    """Folder of Stanford models or range scans (`figure7`, `scans`)."""
    sevenscenes: str | None = None
    """Folder of 7-Scenes (`table5`, `fragments`)."""
    scale: str = "full"
    """`full`: presets as they are, the paper's size for an accelerator; `short`: those for a fifth of the epochs; `cpu`: the same
    comparisons for two cores; `cpu-long`: those on ten times the pairs; `toy`: a test of the machinery."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the trainings; the table shows mean and standard deviation."""
    runs: Path = Path("runs/experiments")
    """Folder of the run folders and results, one folder for each scale in it."""
    limit: int | None = None
    """Evaluate on this many test pairs, evenly spaced, instead of all."""
    rows: tuple[str, ...] = ()
    """Run only the rows with these labels, as `list` names them; the tables show results of the others that exist."""
    baselines: bool = True
    """Also run the methods without learning."""
    only_collect: bool = False
    """Run nothing: write the tables of the results that exist."""
    jemalloc: bool = True
    """Use the memory allocator jemalloc, if it is installed (`cmig_jax/cpu_memory.py`)."""


@dataclass(frozen=True)
class Parsed:
    """A command and what it runs on."""

    command: List | Run
    catalogue: Catalogue


def parse(arguments: Sequence[str], prog: str, catalogue: Callable[[], Catalogue]) -> Parsed:
    """Parse `list` or `run` and its flags."""
    commands: Any = Annotated[List, tyro.conf.subcommand("list")] | Annotated[Run, tyro.conf.subcommand("run")]
    return Parsed(parse_flags(commands, prog, arguments), catalogue())


def run(parsed: Parsed) -> int:
    """List the experiments, or run some of them one after the other; return 1 if a row failed.

    Raises:
        ValueError: an unknown experiment or scale.
        Stopped: it was interrupted.
    """
    command, catalogue = parsed.command, parsed.catalogue
    if isinstance(command, List):
        print("\n".join(listing(catalogue)))
        return 0
    names = tuple(catalogue.experiments) if command.names == ("all",) else command.names
    unknown = [name for name in names if name not in catalogue.experiments]
    if unknown or not names:
        raise ValueError(f"experiment {', '.join(unknown)!r}: expected all, or some of {', '.join(catalogue.experiments)}")
    labels = {row.label for name in names for row in catalogue.experiments[name].rows}
    if wrong := [label for label in command.rows if label not in labels]:
        raise ValueError(f"row {', '.join(wrong)!r}: expected some of {', '.join(sorted(labels))}")
    if command.scale not in catalogue.scales:
        raise ValueError(f"scale = {command.scale!r}: expected one of {', '.join(catalogue.scales)}")
    from cmig_jax.compilation import keep_compiled_programs
    from cmig_jax.training.loop import Interrupted

    keep_compiled_programs()
    try:
        failed = [_run_one(command, catalogue, name) for name in names]
        return int(any(failed))
    except (Interrupted, KeyboardInterrupt) as error:
        raise Stopped("stopped; the same command continues") from error


def _run_one(command: Run, catalogue: Catalogue, name: str) -> bool:
    """Run an experiment, write its table, and return whether a row failed."""
    from cmig_jax.experiments.run import Results, collect
    from cmig_jax.experiments.run import run as run_jobs

    experiment, jobs = catalogue.experiments[name], jobs_of(command, catalogue, name)
    print(f"{name}: {experiment.about}")
    chosen = [] if command.only_collect else [job for job in jobs if not command.rows or job.row.label in command.rows]
    others = [job for job in jobs if job not in chosen]
    ran = run_jobs(chosen, with_baselines=experiment.baselines and command.baselines)
    found = collect(others, with_baselines=experiment.baselines)
    outcomes = {id(outcome.job): outcome for outcome in (*ran.outcomes, *found.outcomes)}
    results = Results(tuple(outcomes[id(job)] for job in jobs), ran.baselines or found.baselines)
    write(command.runs / command.scale, name, experiment, results)
    return any(outcome.problem.startswith("failed") for outcome in results.outcomes)


def jobs_of(command: Run, catalogue: Catalogue, name: str) -> list[Job]:
    """List the jobs of an experiment for a command line."""
    from cmig_jax.experiments.plan import plan

    roots = {"data": command.data, "stanford": command.stanford, "sevenscenes": command.sevenscenes}
    return plan(
        catalogue.experiments[name],
        catalogue,
        scale=command.scale,
        roots=roots,
        source=command.source,
        seeds=command.seeds,
        runs=command.runs / command.scale,
        limit=command.limit,
    )


def listing(catalogue: Catalogue) -> list[str]:
    """Describe all experiments."""
    lines = []
    for name, experiment in catalogue.experiments.items():
        lines += ["", f"{name}: {experiment.about}", f"  all rows: {_flags(experiment.protocol)}"]
        for row in experiment.rows:
            at_test = (f"; at test {_flags(row.test)}" if row.test else "") + (f"; then {row.then}" if row.then else "")
            lines.append(f"  {row.label:26} {f'{row.preset}: {_flags(row.flags)}{at_test}' if row.preset else row.absent}")
    return lines[1:]


def _flags(flags: Flags) -> str:
    texts = {flag: " ".join(map(str, value)) if isinstance(value, tuple) else value for flag, value in flags.items()}
    return " ".join(f"{flag}={text}" for flag, text in texts.items()) or "as it is"


def write(folder: Path, name: str, experiment: Experiment, results: Results) -> None:
    """Print the table; write it as text, Markdown, LaTeX and JSON, and draw it."""
    from cmig_jax.experiments.figure import plot_rows
    from cmig_jax.experiments.table import as_json, notes, table
    from cmig_jax.files import write_text

    folder.mkdir(parents=True, exist_ok=True)
    text = table(experiment, results) + "".join(f"{line}\n" for line in notes(experiment, results))
    print(text, flush=True)
    write_text(folder / f"{name}.txt", text)
    write_text(folder / f"{name}.md", table(experiment, results, "markdown"))
    write_text(folder / f"{name}.tex", table(experiment, results, "latex"))
    write_text(folder / f"{name}.json", json.dumps(as_json(name, experiment, results), indent=1) + "\n")
    if any(outcome.metrics for outcome in results.outcomes):
        plot_rows(name, experiment, results, folder / f"{name}.png")
