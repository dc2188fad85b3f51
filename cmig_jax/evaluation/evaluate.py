"""The evaluation of a trained network beside other methods on its test pairs (Sec. IV-B)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cmig_jax.config_json import to_json
from cmig_jax.data.pairs import Pairs
from cmig_jax.data.recorded_pairs import RecordedPairs
from cmig_jax.evaluation.engine import ERRORS, evaluate
from cmig_jax.evaluation.errors import Errors, read_errors
from cmig_jax.evaluation.methods import Search, methods_for, settings_for
from cmig_jax.evaluation.pairs import pairs_to_test
from cmig_jax.evaluation.tables import latex_table, markdown_table
from cmig_jax.files import write_text
from cmig_jax.inference.load import Network


@dataclass(frozen=True)
class Evaluation:
    """An evaluation in its folder.

    Attributes:
        network: what was evaluated.
        checkpoint: which one it is, in words.
        folder: holds `results.json`, `errors.npz`, `table.md`, `table.tex`.
        pairs: the test pairs.
        results: what `results.json` holds.
        errors: the errors of every pair.
    """

    network: Network
    checkpoint: str
    folder: Path
    pairs: Pairs | RecordedPairs
    results: dict[str, Any]
    errors: Errors


def evaluate_network(
    network: Network,
    folder: Path,
    *,
    command: str,
    checkpoint: str,
    limit: int | None = None,
    batch: int = 16,
    search: Sequence[Search] = (),
) -> Evaluation:
    """Evaluate a network beside the methods without learning on the same test pairs, and write results and tables.

    Args:
        network: with the flags of the test in its config.
        folder: where results go.
        command: what was typed, for the record.
        checkpoint: which checkpoint the network is, for the record.
        limit: how many test pairs, evenly spaced; None: all.
        batch: pairs per call of a method.
        search: rows of `register`.

    Raises:
        ValueError: no test objects in the chosen categories, or too few points.
    """
    config, title = network.config, network.title
    pairs = pairs_to_test(config, limit)
    settings = json.loads(to_json(config)) | {"checkpoint": checkpoint, "limit": limit} | settings_for(network, search)
    results = evaluate(pairs, methods_for(network, search), folder, command=command, config=settings, chunk=batch)
    write_text(folder / "table.md", markdown_table(results))
    write_text(folder / "table.tex", latex_table(results))
    errors = read_errors(folder / ERRORS, network=title, categories=pairs.categories)
    return Evaluation(network, checkpoint, folder, pairs, results, errors)
