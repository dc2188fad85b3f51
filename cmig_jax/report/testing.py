"""The evaluation of a run: its network beside the baselines on the test pairs, tables, pictures, the report (Sec. IV-B)."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cmig_jax import baselines
from cmig_jax.config import Config, is_inside, to_json
from cmig_jax.data.pairs import Pair, Pairs, evenly_spaced, in_categories
from cmig_jax.data.prepare import ensure_prepared
from cmig_jax.data.recorded_pairs import RecordedPairs
from cmig_jax.data.recordings import SOURCES as RECORDED
from cmig_jax.data.recordings import ensure_recordings
from cmig_jax.data.shards import Shards, check_settings
from cmig_jax.evaluation import ERRORS, Method, evaluate, one_by_one
from cmig_jax.nn.build import uses_images
from cmig_jax.registration import Network, load
from cmig_jax.report.errors import Errors, read_errors
from cmig_jax.report.figures import write_figures
from cmig_jax.report.gallery import Example, choose
from cmig_jax.report.matches import Matches, matches
from cmig_jax.report.overlap import Measured
from cmig_jax.report.page import Report, write_page
from cmig_jax.report.plots import plot_curve, plot_pairs, plot_views
from cmig_jax.report.tables import latex_table, markdown_table, text_table
from cmig_jax.training.checkpoint import is_validated, write_atomically

NETWORK = "CMIGNet"
PAGE = "report.html"
PICTURED = 4  # pairs


def evaluate_run(
    run: Path,
    config: Config,
    command: str,
    *,
    which: Literal["best", "last"] = "best",
    limit: int | None = None,
    batch: int = 16,
    out: str = "evaluation",
    report_pairs: int | None = None,
) -> dict[str, Any]:
    """Evaluate a run's network beside other methods on the same test pairs; print the table, write results and pictures.

    Args:
        run: the run folder.
        config: the run's flags, with those of the test.
        command: what was typed, for the record.
        which: checkpoint.
        limit: how many test pairs, evenly spaced; None: all.
        batch: pairs per call of the network.
        out: name of the folder inside the run folder.
        report_pairs: also write the report (`report.html` and its figures), with this many pairs.

    Returns:
        What `results.json` holds.

    Raises:
        ValueError: no checkpoint, or no test objects in the chosen categories; `report_pairs` or `batch` below 1; an `out` elsewhere.
    """
    if report_pairs is not None and report_pairs < 1:
        raise ValueError(f"report_pairs = {report_pairs}: expected at least 1 pair")
    if batch < 1:
        raise ValueError(f"batch = {batch}: expected at least 1 pair")
    if not is_inside(out) or Path(out).parts[0] in ("checkpoints", "tensorboard"):
        raise ValueError(f"out = {out!r}: expected the name of a new folder, or of one that results are in, inside the run folder")
    network = load(run, which, batch, config=config)
    if which == "best" and not is_validated(run):
        print(f"{run}: none of its checkpoints was validated, so this is the last one, step {network.step}")
        which = "last"
    pairs = pairs_to_test(config, limit)
    measured = Measured(pairs, config.loss.match_threshold)
    folder = run / out
    settings = json.loads(to_json(config)) | {"checkpoint": {"which": which, "step": network.step}}
    settings["baselines"] = {name: method.settings for name, method in baselines.classical(config.data).items()}
    settings["finish"] = baselines.CUTOFFS
    results = evaluate(measured, methods_for(network), folder, command=command, config=settings, chunk=batch)
    write_atomically(folder / "table.md", markdown_table(results))
    write_atomically(folder / "table.tex", latex_table(results))
    errors = read_errors(folder / ERRORS, network=NETWORK, overlap=measured.overlaps, categories=pairs.categories)
    print(text_table(results))
    draw(run, folder, network, pairs, errors)
    for name, reason in baselines.missing().items():
        print(f"without {name}: {reason}")
    if report_pairs is not None:
        examples = examples_of(network, pairs, errors, report_pairs)
        figures = write_figures(folder, errors)
        checkpoint = f"{which}, step {network.step}"
        write_page(folder / PAGE, Report(run.resolve().name, checkpoint, config, results, errors, examples, figures))
        print(f"report: {folder / PAGE}")
    print(f"results and pictures are in {folder}")
    return results


def methods_for(network: Network) -> dict[str, Method]:
    """Return what is compared, by name: methods without learning, the network, and the network finished by ICP and by generalised ICP."""
    methods = baselines.classical(network.config.data)
    return {name: one_by_one(method.register) for name, method in methods.items()} | {
        NETWORK: lambda pairs: network([dict(pair) for pair in pairs]),
        f"{NETWORK} + ICP": lambda pairs: refined(network, [dict(pair) for pair in pairs], baselines.finish_by_icp),
        f"{NETWORK} + GICP": lambda pairs: refined(network, [dict(pair) for pair in pairs], baselines.finish_by_gicp),
    }


def refined(network: Network, pairs: Sequence[Pair], finish: Callable[..., baselines.Pose]) -> tuple[np.ndarray, np.ndarray]:
    """Register pairs by the network, then from its poses by a finish, `baselines.finish_by_icp` or `_gicp`: R `[n, 3, 3]`, t `[n, 3]`."""
    starts = zip(*network(pairs), strict=True)
    poses = [finish(p["source"], p["target"], start) for p, start in zip(pairs, starts, strict=True)]
    return np.stack([R for R, _ in poses]), np.stack([t for _, t in poses])


def pairs_to_test(config: Config, limit: int | None = None) -> Pairs | RecordedPairs:
    """Return the test pairs of a config: those of `data.test_categories`, or the recorded ones; the same for every method and machine.

    Raises:
        ValueError: there is no test object.
    """
    if config.data.source in RECORDED:
        return RecordedPairs(ensure_recordings(config.data), config, uses_images(config), limit)
    folder = ensure_prepared(config)
    check_settings(folder, config)
    objects = Shards(folder, "test")
    chosen = in_categories(objects.labels, objects.categories, config.data.test_categories, config.data.exclude)
    chosen = chosen[evenly_spaced(len(chosen), limit)]
    if len(chosen) == 0:
        where = f"data.test_categories={config.data.test_categories} without data.exclude={config.data.exclude}"
        raise ValueError(f"{folder}: expected test objects in {where}, found none")
    return Pairs(objects, chosen, config, config.data.test_seed, uses_images(config))


def draw(run: Path, folder: Path, network: Network, pairs: Pairs | RecordedPairs, errors: Errors) -> None:
    """Draw some pairs before and after, the views of one, and the training curve."""
    positions = [int(i) for i in np.unique(np.linspace(0, len(pairs) - 1, PICTURED).astype(int))]
    chosen = [pairs[i] for i in positions]
    matched = matches(network, chosen, network.config.loss.match_threshold)
    pictures = [picture(pair, found, errors, i) for pair, found, i in zip(chosen, matched, positions, strict=True)]
    plot_pairs(pictures, folder / "pairs.png")
    if "views" in chosen[0]:
        plot_views(chosen[0]["views"][0], folder / "views.png", title="depth views of the source")
    if (run / "log.jsonl").exists():
        try:
            plot_curve(run / "log.jsonl", folder / "curve.png")
        except ValueError as error:
            print(f"no training curve: {error}")


def picture(pair: Pair, found: Matches | None, errors: Errors, position: int) -> dict[str, Any]:
    """Describe a pair for `plot_pairs`: the pose that the network found, and the correspondences that the pose counts."""
    poses = errors.methods[errors.network]
    described = {**pair, "R": poses.R[position], "t": poses.t[position], "title": errors.category[position]}
    if found is not None:
        source, target = found.source[found.used], found.target[found.chosen[found.used]]
        described |= {"source_keypoints": source, "target_keypoints": target, "correct": found.right[found.used]}
    return described


def examples_of(network: Network, pairs: Pairs | RecordedPairs, errors: Errors, count: int) -> list[Example]:
    """Collect the pairs of the report, with what the network matched in them."""
    chosen = choose(errors.methods[errors.network].rotation_deg, count)
    drawn = [pairs[position] for position, _ in chosen]
    matched = matches(network, drawn, network.config.loss.match_threshold, progress=True)
    names = pairs.names if isinstance(pairs, RecordedPairs) else [f"object {index}" for index in errors.index]
    return [
        Example(position, rank, pair, found, names[position]) for (position, rank), pair, found in zip(chosen, drawn, matched, strict=True)
    ]
