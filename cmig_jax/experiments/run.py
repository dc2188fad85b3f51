"""Train what is missing, evaluate, and collect the results of an experiment."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from cmig_jax import baselines
from cmig_jax.config import Config
from cmig_jax.config_json import to_json
from cmig_jax.data.sources import source_of
from cmig_jax.evaluation.engine import METADATA, RESULTS, evaluate, one_by_one
from cmig_jax.evaluation.methods import methods_for, refined_row
from cmig_jax.evaluation.pairs import pairs_to_test
from cmig_jax.experiments.plan import Job
from cmig_jax.inference.load import load
from cmig_jax.inference.run_folder import last_step
from cmig_jax.training.checkpoint import check_config
from cmig_jax.training.loop import NonFiniteLoss, train


@dataclass(frozen=True)
class Outcome:
    """The result of a job.

    Attributes:
        job: the job.
        metrics: of the network, as `evaluate` returns them; None where there are none.
        problem: why there are none: not run, or how it failed.
    """

    job: Job
    metrics: Mapping[str, float] | None = None
    problem: str = ""


@dataclass(frozen=True)
class Results:
    """An experiment's outcomes, and the methods without learning on the same pairs, by name."""

    outcomes: tuple[Outcome, ...]
    baselines: Mapping[str, Mapping[str, float]] = field(default_factory=dict)


def run(jobs: Sequence[Job], *, with_baselines: bool) -> Results:
    """Run jobs one after the other; trainings and evaluations of an earlier call are not repeated.

    A job that fails does not stop the others: its outcome says how. Ctrl-C does, after saving; the same call continues.

    Args:
        jobs: of one experiment.
        with_baselines: also evaluate the methods without learning, on the pairs of the first job that has any.

    Raises:
        Interrupted, KeyboardInterrupt: the run was stopped.
    """
    outcomes = []
    for i, job in enumerate(jobs):
        print(f"[{i + 1}/{len(jobs)}] {job.row.label}, seed {job.seed}: {job.run.name}")
        outcomes.append(_outcome(job))
        if outcomes[-1].problem:
            print(f"  {outcomes[-1].problem}")
    done = [outcome.job for outcome in outcomes if outcome.metrics is not None]
    return Results(tuple(outcomes), _baselines(done[0]) if with_baselines and done else {})


def collect(jobs: Sequence[Job], *, with_baselines: bool) -> Results:
    """Read the results that exist, and run nothing."""
    found = [(job, _stored(job.run / job.evaluation, _settings(job))) for job in jobs]
    outcomes = tuple(Outcome(job, results[_row(job)]) if results else Outcome(job, problem="not run") for job, results in found)
    first = next((job for job, results in found if results), None)
    others = _stored(_baseline_folder(first), _baseline_settings(first)) if first and with_baselines else None
    return Results(outcomes, _methods_of(others) if others else {})


def _outcome(job: Job) -> Outcome:
    for config in (job.training, job.test):
        if config.data.root is None and source_of(config.data).folder is not None:
            return Outcome(job, problem=f"not run: no folder of {config.data.source} data was given")
    try:
        results = _stored(job.run / job.evaluation, _settings(job))
        if results is None:
            _train(job)
            results = _evaluate(job)
    except (ValueError, OSError, jax.errors.JaxRuntimeError, NonFiniteLoss) as error:  # JAX's: out of memory
        return Outcome(job, problem=f"failed: {error}")
    return Outcome(job, results[_row(job)])


def _row(job: Job) -> str:
    title = job.test.model.title
    return refined_row(title, job.row.then) if job.row.then else title


def _train(job: Job) -> None:
    check_config(job.run, job.training)
    if not is_trained(job.run, job.training):
        train(job.training, job.run, resume=True)
        jax.clear_caches()  # a series of runs would keep every program that it compiled


def is_trained(run: Path, config: Config) -> bool:
    """Return whether a run folder holds the last epoch: its log ends there, and so do its checkpoints."""
    path = run / "log.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    last = json.loads(lines[-1]) if lines and lines[-1].endswith("}") else {}
    return last.get("epoch") == config.optim.epochs and last_step(run) == last["step"]


def _evaluate(job: Job) -> dict[str, Any]:
    batch, row = job.training.optim.batch, _row(job)
    methods = {row: methods_for(load(job.run, "best", batch, config=job.test))[row]}
    pairs, folder, settings = pairs_to_test(job.test, job.limit), job.run / job.evaluation, _settings(job)
    results = evaluate(pairs, methods, folder, command=job.commands()[1], config=settings, chunk=batch)
    jax.clear_caches()
    return results


def _settings(job: Job) -> dict[str, Any]:
    """Return what the results depend on, beside the checkpoint: a run is trained to its end before it is evaluated."""
    settings = json.loads(to_json(job.test)) | {"limit": job.limit, "trained": json.loads(to_json(job.training))}
    return settings | ({"refinement": baselines.CUTOFFS[job.row.then]} if job.row.then else {})


def _baselines(job: Job) -> Mapping[str, Mapping[str, float]]:
    folder, settings = _baseline_folder(job), _baseline_settings(job)
    results = _stored(folder, settings)
    if results is None:
        methods = {name: one_by_one(method.register) for name, method in baselines.classical(job.test.data).items()}
        results = evaluate(pairs_to_test(job.test, job.limit), methods, folder, command=job.commands()[1], config=settings)
    return _methods_of(results)


def _baseline_folder(job: Job) -> Path:
    pairs = json.dumps(json.loads(to_json(job.test))["data"], sort_keys=True)
    return job.run.parent / f"baselines-{hashlib.sha256(pairs.encode()).hexdigest()[:8]}"


def _baseline_settings(job: Job) -> dict[str, Any]:
    return {
        "data": json.loads(to_json(job.test))["data"],
        "limit": job.limit,
        "baselines": {name: method.settings for name, method in baselines.classical(job.test.data).items()},
    }


def _methods_of(results: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    return {name: metrics for name, metrics in results.items() if name not in METADATA}


def _stored(folder: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the results of an evaluation with these settings, if there are any."""
    path = folder / RESULTS
    if not path.exists():
        return None
    try:
        results = json.loads(path.read_text())
        return results if results["config"] == settings else None
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not readable ({error}); delete it, and the same command evaluates again") from error
