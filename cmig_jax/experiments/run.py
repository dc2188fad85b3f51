"""Train what is missing, evaluate, and collect the results of an experiment."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from cmig_jax import baselines
from cmig_jax.config import Config, to_json
from cmig_jax.evaluation import METADATA, RESULTS, Method, evaluate, one_by_one
from cmig_jax.experiments.plan import Job
from cmig_jax.registration import load
from cmig_jax.report.testing import methods_for, pairs_to_test
from cmig_jax.training.checkpoint import check_config, last_step
from cmig_jax.training.loop import NonFiniteLoss, train

NETWORK = "CMIGNet"


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

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


def run(jobs: Sequence[Job], *, with_baselines: bool, limit: int | None = None, say: Callable[[str], None] = print) -> Results:
    """Run jobs one after the other; what an earlier call finished is not done again.

    A job that fails does not stop the others: its outcome says how. Ctrl-C does, after saving; the same call continues.

    Args:
        jobs: of one experiment.
        with_baselines: also evaluate the methods without learning, on the pairs of the first job that has any.
        limit: test pairs, evenly spaced, instead of all.
        say: prints a line of progress.

    Raises:
        Interrupted, KeyboardInterrupt: the run was stopped.
    """
    outcomes = []
    for i, job in enumerate(jobs):
        say(f"[{i + 1}/{len(jobs)}] {job.row.label}, seed {job.seed}: {job.run.name}")
        outcomes.append(_outcome(job, limit))
        if outcomes[-1].problem:
            say(f"  {outcomes[-1].problem}")
    done = [outcome.job for outcome in outcomes if outcome.metrics is not None]
    return Results(tuple(outcomes), _baselines(done[0], limit) if with_baselines and done else {})


def collect(jobs: Sequence[Job], *, with_baselines: bool, limit: int | None = None) -> Results:
    """Read the results that are there, and run nothing."""
    found = [(job, _finished(job.run / job.evaluation, _settings(job, limit))) for job in jobs]
    outcomes = tuple(Outcome(job, r[NETWORK]) if r else Outcome(job, problem="not run") for job, r in found)
    first = next((job for job, results in found if results), None)
    others = _finished(_baseline_folder(first), _baseline_settings(first.test, limit)) if first and with_baselines else None
    return Results(outcomes, _methods_of(others) if others else {})


def _outcome(job: Job, limit: int | None) -> Outcome:
    for config in (job.training, job.test):
        if config.data.root is None and config.data.source != "shapes":
            return Outcome(job, problem=f"not run: no folder of {config.data.source} data was given")
    try:
        results = _finished(job.run / job.evaluation, _settings(job, limit))
        if results is None:
            _train(job)
            results = _evaluate(job, limit)
    except (ValueError, OSError, NonFiniteLoss) as error:
        return Outcome(job, problem=f"failed: {error}")
    return Outcome(job, results[NETWORK])


def _train(job: Job) -> None:
    check_config(job.run, job.training)
    if not is_trained(job.run, job.training):
        train(job.training, job.run, resume=True)
        jax.clear_caches()  # a sweep would keep every program that it ever compiled


def is_trained(run: Path, config: Config) -> bool:
    """Whether a run folder holds the last epoch: its log ends there, and so do its checkpoints."""
    path = run / "log.jsonl"
    lines = path.read_text().splitlines() if path.exists() else []
    last = json.loads(lines[-1]) if lines and lines[-1].endswith("}") else {}
    return last.get("epoch") == config.optim.epochs and last_step(run) == last["step"]


def _evaluate(job: Job, limit: int | None) -> dict[str, Any]:
    batch = job.training.optim.batch
    network = load(job.run, "best", batch, config=job.test)
    method = methods_for(network)[f"{NETWORK} + {job.row.then}" if job.row.then else NETWORK]
    folder = job.run / job.evaluation
    results = evaluate(
        pairs_to_test(job.test, limit), {NETWORK: method}, folder, command=job.commands()[1], config=_settings(job, limit), chunk=batch
    )
    jax.clear_caches()
    return results


def _settings(job: Job, limit: int | None) -> dict[str, Any]:
    """What the results depend on, beside the checkpoint: a run is trained to its end before it is evaluated."""
    settings = json.loads(to_json(job.test)) | {"limit": limit, "trained": json.loads(to_json(job.training))}
    return settings | ({"finish": baselines.CUTOFFS[job.row.then]} if job.row.then else {})


def _baselines(job: Job, limit: int | None) -> Mapping[str, Mapping[str, float]]:
    folder, settings = _baseline_folder(job), _baseline_settings(job.test, limit)
    results = _finished(folder, settings)
    if results is None:
        results = evaluate(pairs_to_test(job.test, limit), _classical(job.test), folder, command=job.commands()[1], config=settings)
    return _methods_of(results)


def _classical(test: Config) -> dict[str, Method]:
    return {name: one_by_one(method.register) for name, method in baselines.classical(test.data).items()}


def _baseline_folder(job: Job) -> Path:
    pairs = json.dumps(json.loads(to_json(job.test))["data"], sort_keys=True)
    return job.run.parent / f"baselines-{hashlib.sha256(pairs.encode()).hexdigest()[:8]}"


def _baseline_settings(test: Config, limit: int | None) -> dict[str, Any]:
    return {
        "data": json.loads(to_json(test))["data"],
        "limit": limit,
        "baselines": {name: method.settings for name, method in baselines.classical(test.data).items()},
    }


def _methods_of(results: Mapping[str, Any]) -> dict[str, Mapping[str, float]]:
    return {name: metrics for name, metrics in results.items() if name not in METADATA}


def _finished(folder: Path, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read a finished evaluation; one of other settings is set aside."""
    path = folder / RESULTS
    if not path.exists():
        return None
    results = json.loads(path.read_text())
    return results if results["config"] == settings else None
