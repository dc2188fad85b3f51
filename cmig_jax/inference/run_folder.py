"""Reading a run folder: `config.json`, and `checkpoints/` with the last step and the best on validation."""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
from flax.traverse_util import flatten_dict
from orbax.checkpoint import v1 as ocp

from cmig_jax.config import Config
from cmig_jax.models.networks import config_from_json

CONFIG = "config.json"

T = TypeVar("T")


def read_config(run: Path) -> Config:
    """Read the config of a run folder.

    Raises:
        ValueError: no such folder, no config, or one of another version; the message names the file.
    """
    path = run / CONFIG
    if not path.is_file():
        raise ValueError(f"{run}: expected a run folder (with config.json, as train.py writes it)")
    try:
        return config_from_json(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def load_variables(run: Path, like: Mapping[str, Any], which: Literal["best", "last"] = "best") -> tuple[int, dict[str, Any]]:
    """Load the variables of a run's network, by default those of the best checkpoint on validation.

    Args:
        run: the run folder.
        like: shapes and types of the variables, `params` and `batch_stats`.
        which: `best` on validation (the last, if none was validated yet), or `last`.

    Returns:
        The training steps behind the checkpoint, and the variables.

    Raises:
        ValueError: no checkpoint there, or one that is unreadable or of another network; the message names the folder.
    """
    folder = checkpoint_folder(run)
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected checkpoints, found no such folder (has train.py run long enough to save one?)")
    context = ocp.Context()
    context.pytree.loading.partial_load = True  # without the optimiser's state
    with context, opened(folder) as checkpointer:
        found = read_checkpoint(f"{folder}", lambda: checkpointer.checkpoints)
        if not found:
            raise ValueError(f"{folder}: expected a checkpoint, found none (has train.py run long enough to save one?)")
        chosen = max(found, key=lambda c: (rank(c.metrics) if which == "best" else 0, c.step))
        return chosen.step, read_checkpoint(f"{folder}, step {chosen.step}", lambda: _load_part(checkpointer, chosen.step, like))


def _load_part(checkpointer: Any, step: int, like: Mapping[str, Any]) -> dict[str, Any]:
    """Load some collections of a checkpoint; Orbax by itself leaves out what the checkpoint has more, and returns what it has less."""
    saved = checkpointer.metadata(step).metadata
    if saved is None:
        raise ValueError("its metadata cannot be read")
    for collection, tree in like.items():
        expected, found = (set(flatten_dict(x, sep="/")) for x in (tree, saved.get(collection, {})))
        if expected != found:
            raise ValueError(f"{collection}: {', '.join(sorted(expected ^ found)[:4])} only in one of them")
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    placed = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=x.sharding or device), dict(like))
    return checkpointer.load(step, placed)


def last_step(run: Path) -> int | None:
    """Return the step of a run's last checkpoint, or None without one."""
    folder = checkpoint_folder(run)
    if not folder.is_dir():
        return None
    with opened(folder) as checkpointer:
        latest = read_checkpoint(f"{folder}", lambda: checkpointer.latest)
        return None if latest is None else latest.step


def is_validated(run: Path) -> bool:
    """Return whether a checkpoint of a run has validation measures, so that `best` differs from `last`."""
    with opened(checkpoint_folder(run)) as checkpointer:
        return any(rank(checkpoint.metrics) > -math.inf for checkpoint in checkpointer.checkpoints)


def validation_error(measures: Mapping[str, float] | None) -> float:
    """Return what selects the best checkpoint: the mean angle (radians) plus the mean length of the motion to the true pose.

    No point of the unit sphere is farther than this, on average, from where it belongs. RMSE(R) alone ignores the translation, and a
    few pairs decide it. Infinite without measures.
    """
    if not measures or not {"val_iso_r_deg_mean", "val_iso_t_mean"} <= set(measures):
        return math.inf
    return math.radians(measures["val_iso_r_deg_mean"]) + measures["val_iso_t_mean"]


def rank(measures: Any) -> float:
    """Return a number that is larger for a better checkpoint."""
    return -validation_error(measures)


def checkpoint_folder(run: Path) -> Path:
    """Return the folder of a run's checkpoints; Orbax needs an absolute path."""
    return (run / "checkpoints").absolute()


def opened(folder: Path, **options: Any) -> Any:
    """Open a folder of checkpoints."""
    return read_checkpoint(f"{folder}", lambda: ocp.training.Checkpointer(str(folder), **options))


def read_checkpoint(where: str, read: Callable[[], T]) -> T:
    """Call `read`; where it fails, give the cause once: Orbax names the last handler that it tried, and logs the errors of every task.

    Raises:
        ValueError: it failed.
    """
    with _silent("absl", "asyncio"):
        try:
            return read()
        except (ValueError, KeyError, TypeError, OSError) as error:
            cause: BaseException = error
            while cause.__cause__ is not None:
                cause = cause.__cause__
            text = (str(cause).splitlines() or [type(cause).__name__])[0][:300]
            del cause
        gc.collect()  # tasks that were dropped report their errors when they are collected
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
