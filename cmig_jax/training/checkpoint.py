"""A run folder on disk: `config.json`, `checkpoints/` (the last step and the best on validation), logs. All of Orbax is here."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from orbax.checkpoint import v1 as ocp

from cmig_jax.config import Config, from_json, to_json

FREE = ("name", "data.root", "data.prepared", "compute.recompute", "compute.rows")
"""Flags that a run may change where it continues: they change where things are and how they are computed, not what."""

T = TypeVar("T")


class Checkpoints:
    """The checkpoints of a run: saved whole or not at all, the last and the best kept."""

    def __init__(self, run: Path) -> None:
        policies = ocp.training.preservation_policies
        best = policies.BestN(get_metric_fn=_rank, n=1, keep_checkpoints_without_metrics=False)
        self._folder = (run / "checkpoints").absolute()
        kept = policies.AnyPreservationPolicy([policies.LatestN(1), best])
        self._checkpointer = _opened(self._folder, preservation_policy=kept, cleanup_tmp_directories=True)

    def save(self, step: int, state: Any, iterator: dict[str, Any], measures: dict[str, float] | None = None) -> None:
        """Save the state after `step` steps with the input pipeline's position and, at the end of an epoch, validation measures."""
        if self.last == step:
            return
        self._checkpointer.save(step, state, metrics=measures, custom_metadata={"iterator": iterator}, force=True)

    def restore_last(self, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """Return the last state, typed and placed as the abstract `like` says, and the pipeline's position; None if there is none."""
        latest = _read(f"{self._folder}", lambda: self._checkpointer.latest)
        if latest is None:
            return None
        where = f"{self._folder}, step {latest.step}"
        iterator = _read(where, lambda: self._checkpointer.metadata(latest.step).custom_metadata["iterator"])
        return _read(where, lambda: self._checkpointer.load(latest.step, like)), iterator

    @property
    def last(self) -> int | None:
        """The step of the last checkpoint, None where there is none."""
        latest = self._checkpointer.latest
        return None if latest is None else latest.step

    def close(self) -> None:
        """Finish writing."""
        self._checkpointer.close()


def validation_error(measures: Mapping[str, float] | None) -> float:
    """Return what the best checkpoint is chosen by: the mean angle (radians) plus the mean length of the motion to the true pose.

    No point of the unit sphere is farther than this, on average, from where it belongs. RMSE(R) alone knows nothing of the translation,
    and a few pairs decide it. Infinite where nothing was measured.
    """
    if not measures or not {"val_iso_r_deg_mean", "val_iso_t_mean"} <= set(measures):
        return math.inf
    return math.radians(measures["val_iso_r_deg_mean"]) + measures["val_iso_t_mean"]


def _rank(measures: Any) -> float:
    return -validation_error(measures)


def write_config(run: Path, config: Config) -> None:
    """Write `config.json` into a run folder, where it is not of another config.

    Raises:
        ValueError: the folder is of another config; the message names the flags that differ.
    """
    check_config(run, config)
    run.mkdir(parents=True, exist_ok=True)
    write_atomically(run / "config.json", to_json(config))


def check_config(run: Path, config: Config) -> None:
    """Refuse a run folder of another config; one without a config is fine, and so are flags that change nothing that is computed.

    Raises:
        ValueError: the message names the flags that differ.
    """
    path = run / "config.json"
    if path.exists() and (changed := [flag for flag in differences(read_config(run), config) if flag.split(":")[0] not in FREE]):
        raise ValueError(f"{path} is of another config ({'; '.join(changed)}): continue with its flags, or choose another --name")


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


def last_step(run: Path) -> int | None:
    """Return the step of a run's last checkpoint, or None where there is none."""
    folder = (run / "checkpoints").absolute()
    if not folder.is_dir():
        return None
    with _opened(folder) as checkpointer:
        latest = _read(f"{folder}", lambda: checkpointer.latest)
        return None if latest is None else latest.step


def is_validated(run: Path) -> bool:
    """Whether a checkpoint of a run has validation measures, so that `best` means more than `last`."""
    with _opened((run / "checkpoints").absolute()) as checkpointer:
        return any(_rank(checkpoint.metrics) > -math.inf for checkpoint in checkpointer.checkpoints)


def load_state(run: Path, like: Any, which: Literal["best", "last"] = "best") -> Any:
    """Load the state of a run, by default the best on validation.

    Args:
        run: the run folder.
        like: an abstract state of its network (`state.abstract_state`).
        which: `best` on validation (the last, if none was validated yet), or `last`.

    Raises:
        ValueError: no checkpoint there, or one that is unreadable or of another network; the message names the folder.
    """
    folder = (run / "checkpoints").absolute()
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected checkpoints, found no such folder (has train.py run long enough to save one?)")
    with _opened(folder) as checkpointer:
        found = _read(f"{folder}", lambda: checkpointer.checkpoints)
        if not found:
            raise ValueError(f"{folder}: expected a checkpoint, found none (has train.py run long enough to save one?)")
        chosen = max(found, key=lambda c: (_rank(c.metrics) if which == "best" else 0, c.step))
        return _read(f"{folder}, step {chosen.step}", lambda: checkpointer.load(chosen.step, like))


def _opened(folder: Path, **options: Any) -> Any:
    return _read(f"{folder}", lambda: ocp.training.Checkpointer(str(folder), **options))


def _read(where: str, read: Callable[[], T]) -> T:
    """Read from checkpoints; where it fails, say why once: Orbax names the last handler that it tried, and logs what every task met."""
    with _silent("absl", "asyncio"):
        try:
            return read()
        except (ValueError, KeyError, TypeError, OSError) as error:
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            text = (str(cause).splitlines() or [type(cause).__name__])[0][:300]
            del cause
        gc.collect()  # the tasks that were dropped speak up when they are collected
    raise ValueError(f"{where}: expected a whole checkpoint of the network in config.json ({text})")


@contextlib.contextmanager
def _silent(*names: str) -> Iterator[None]:
    loggers = [logging.getLogger(name) for name in names]
    levels, hook = [logger.level for logger in loggers], sys.unraisablehook
    sys.unraisablehook = lambda _: None
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
