"""The evaluation of a run: its network beside the baselines on the test pairs, a table, and pictures (Sec. IV-B)."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from cmig_jax import baselines
from cmig_jax.config import Config, to_json
from cmig_jax.data.loader import stack
from cmig_jax.data.pairs import Pair, Pairs, in_categories
from cmig_jax.data.prepare import ensure_prepared
from cmig_jax.data.shards import Shards, check_settings
from cmig_jax.evaluation import evaluate, one_by_one
from cmig_jax.nn.build import uses_images
from cmig_jax.registration import Network, load
from cmig_jax.report.plots import plot_curve, plot_pairs, plot_views
from cmig_jax.report.tables import text_table
from cmig_jax.training.mesh import to_device

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
) -> dict[str, Any]:
    """Evaluate a run's network, identity and ICP on the same test pairs; print the table, write results and pictures.

    Args:
        run: the run folder.
        config: the run's flags, with the test data's.
        command: what was typed, for the record.
        which: checkpoint.
        limit: how many test pairs, evenly spaced; None: all.
        batch: pairs per call of the network.
        out: folder inside the run folder.

    Returns:
        What `results.json` holds.

    Raises:
        ValueError: no checkpoint, or no test objects in the chosen categories.
    """
    network = load(run, which, batch)
    pairs = pairs_to_test(config, limit)
    methods = {
        "identity": one_by_one(baselines.identity),
        "ICP (cutoff 0.02)": one_by_one(baselines.icp_cutoff),
        "ICP (tuned)": one_by_one(baselines.icp_tuned),
        "CMIGNet": network,
        "CMIGNet + ICP": lambda chunk: refined(network, [dict(pair) for pair in chunk]),
    }
    folder = run / out
    settings = json.loads(to_json(config)) | {"checkpoint": {"which": which, "step": network.step}}
    results = evaluate(pairs, methods, folder, command=command, config=settings, chunk=batch)
    draw(run, folder, network, pairs)
    print(text_table(results))
    print(f"results and pictures are in {folder}")
    return results


def refined(network: Network, pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray]:
    """Register pairs by the network, then by point-to-point ICP from its poses: R `[n, 3, 3]`, t `[n, 3]`."""
    starts = zip(*network(pairs), strict=True)
    poses = [baselines.icp(p["source"], p["target"], max_distance=0.1, start=start) for p, start in zip(pairs, starts, strict=True)]
    return np.stack([R for R, _ in poses]), np.stack([t for _, t in poses])


def pairs_to_test(config: Config, limit: int | None = None) -> Pairs:
    """Return the test pairs of a config: those of `data.test_categories`, the same for every method and machine.

    Raises:
        ValueError: there is no test object.
    """
    folder = ensure_prepared(config)
    check_settings(folder, config)
    objects = Shards(folder, "test")
    chosen = in_categories(objects.labels, len(objects.categories), config.data.test_categories)
    if limit is not None:
        if limit < 1:
            raise ValueError(f"limit = {limit}: expected at least 1 pair")
        chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, min(limit, len(chosen))).astype(int))]
    if len(chosen) == 0:
        raise ValueError(f"{folder}: expected test objects in data.test_categories={config.data.test_categories}, found none")
    return Pairs(objects, chosen, config, config.data.test_seed, uses_images(config))


def draw(run: Path, folder: Path, network: Network, pairs: Pairs) -> None:
    """Draw some pairs before and after, the views of one, and the training curve."""
    positions = np.unique(np.linspace(0, len(pairs) - 1, PICTURED).astype(int))
    chosen = [pairs[int(i)] for i in positions]
    plot_pairs(picture(network, chosen, pairs.objects.categories), folder / "pairs.png")
    if "views" in chosen[0]:
        plot_views(chosen[0]["views"][0], folder / "views.png", title="depth views of the source")
    if (run / "log.jsonl").exists():
        plot_curve(run / "log.jsonl", folder / "curve.png")


def picture(network: Network, pairs: list[Pair], categories: tuple[str, ...] | Any) -> list[dict[str, Any]]:
    """Describe pairs for `plot_pairs`: the estimated pose, and the weighted correspondences of the last iteration."""
    prediction = network.predictor.apply(network.variables, to_device(stack(pairs)))
    last = prediction.iterations[-1]
    described = []
    for i, pair in enumerate(pairs):
        found = dataclasses.asdict(prediction.target_from_source)
        R, t = np.asarray(found["R"][i]), np.asarray(found["t"][i])
        described.append({**pair, "R": R, "t": t, "title": categories[int(pair["label"])]})
        if last.weight is not None:
            used = np.asarray(last.weight[i]) > 0
            source = pair["source"][np.asarray(prediction.keypoints.source_index[i])][used]
            target = np.asarray(last.corresponding[i])[used]
            offset = source @ pair["R"].T + pair["t"] - target
            described[-1] |= {"source_keypoints": source, "target_keypoints": target, "correct": np.linalg.norm(offset, axis=1) < 0.05}
    return described
