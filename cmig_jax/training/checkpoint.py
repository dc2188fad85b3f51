"""A run folder on disk: `config.json`, `checkpoints/` (the last step and the best on validation), logs. All of Orbax is here."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any, Literal

from orbax.checkpoint import v1 as ocp

from cmig_jax.config import Config, from_json, to_json

MEASURE = "val_rmse_r_deg"  # what the best checkpoint is chosen by


class Checkpoints:
    """The checkpoints of a run: saved whole or not at all, the last and the best kept."""

    def __init__(self, run: Path) -> None:
        policies = ocp.training.preservation_policies
        best = policies.BestN(get_metric_fn=_rank, n=1, keep_checkpoints_without_metrics=False)
        self._checkpointer: Any = ocp.training.Checkpointer(
            str((run / "checkpoints").absolute()),
            preservation_policy=policies.AnyPreservationPolicy([policies.LatestN(1), best]),  # pyright: ignore[reportArgumentType]
            cleanup_tmp_directories=True,
        )

    def save(self, step: int, state: Any, iterator: dict[str, Any], measures: dict[str, float] | None = None) -> None:
        """Save the state after `step` steps with the input pipeline's position and, at the end of an epoch, validation measures."""
        latest = self._checkpointer.latest
        if latest is not None and latest.step == step:
            return
        self._checkpointer.save(step, state, metrics=measures, custom_metadata={"iterator": iterator}, force=True)

    def restore_last(self, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """Return the last state, typed and placed as the abstract `like` says, and the pipeline's position; None if there is none."""
        latest = self._checkpointer.latest
        if latest is None:
            return None
        metadata = self._checkpointer.metadata(latest.step)
        assert isinstance(metadata.custom_metadata, dict)
        return self._checkpointer.load(latest.step, like), metadata.custom_metadata["iterator"]

    def close(self) -> None:
        """Finish writing."""
        self._checkpointer.close()


def _rank(metrics: Any) -> float:
    return -metrics[MEASURE] if metrics and MEASURE in metrics else -math.inf


def write_config(run: Path, config: Config) -> None:
    """Write `config.json` into a run folder, or check that it holds the same flags.

    Raises:
        ValueError: the folder is of another config; the message names the flags that differ.
    """
    path = run / "config.json"
    if path.exists():
        changed = differences(read_config(run), config)
        if changed:
            raise ValueError(f"{path} is of another config ({'; '.join(changed)}): choose another --name, or remove the folder")
        return
    run.mkdir(parents=True, exist_ok=True)
    write_atomically(path, to_json(config))


def read_config(run: Path) -> Config:
    """Read the config of a run folder.

    Raises:
        ValueError: no such folder, no config, or one of another version; the message names the file.
    """
    path = run / "config.json"
    if not path.is_file():
        raise ValueError(f"{run}: expected a run folder (with config.json, as train.py writes it)")
    try:
        return from_json(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def differences(old: Config, new: Config) -> list[str]:
    """Name the flags in which two configs differ, as `flag: old -> new`."""

    def flatten(tree: Any, prefix: str = "") -> dict[str, Any]:
        if not isinstance(tree, dict):
            return {prefix: tree}
        return {k: v for key, value in tree.items() for k, v in flatten(value, f"{prefix}.{key}".lstrip(".")).items()}

    a, b = (flatten(json.loads(to_json(c))) for c in (old, new))
    return [f"{flag}: {a[flag]} -> {b[flag]}" for flag in a if a[flag] != b[flag]]


def write_atomically(path: Path, text: str) -> None:
    """Write a text file under a temporary name, then rename it."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    temporary.replace(path)


def load_state(run: Path, like: Any, which: Literal["best", "last"] = "best") -> Any:
    """Load the state of a run, by default the best on validation.

    Args:
        run: the run folder.
        like: an abstract state of its network (`state.abstract_state`).
        which: `best` on validation, or `last`.

    Raises:
        ValueError: no checkpoint there, or one that is unreadable or of another network; the message names the folder.
    """
    folder = (run / "checkpoints").absolute()
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected checkpoints, found no such folder (has train.py run long enough to save one?)")
    with ocp.training.Checkpointer(str(folder)) as checkpointer:
        found = checkpointer.checkpoints
        if not found:
            raise ValueError(f"{folder}: expected a checkpoint, found none (has train.py run long enough to save one?)")
        chosen = max(found, key=lambda c: (_rank(c.metrics) if which == "best" else 0, c.step))
        try:
            return checkpointer.load(chosen.step, like)
        except (ValueError, KeyError, OSError) as error:
            raise ValueError(f"{folder}, step {chosen.step}: expected a checkpoint of the network in config.json ({error})") from error
