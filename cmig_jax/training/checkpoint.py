"""Writing a run folder: `config.json`, and the checkpoints of the last step and the best on validation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orbax.checkpoint import v1 as ocp

from cmig_jax.config import Config
from cmig_jax.config_json import differences, to_json
from cmig_jax.files import write_text
from cmig_jax.inference.run_folder import CONFIG, checkpoint_folder, opened, rank, read_checkpoint, read_config

MAY_CHANGE = ("name", "data.root", "data.prepared", "compute.recompute", "compute.rows")
"""Flags that may differ where a run continues: they change where files are and how numbers are computed, not which numbers."""


class Checkpoints:
    """The checkpoints of a run, each written whole or not at all; the last and the best are kept."""

    def __init__(self, run: Path) -> None:
        policies = ocp.training.preservation_policies
        best = policies.BestN(get_metric_fn=rank, n=1, keep_checkpoints_without_metrics=False)
        self._folder = checkpoint_folder(run)
        kept = policies.AnyPreservationPolicy([policies.LatestN(1), best])
        self._checkpointer = opened(self._folder, preservation_policy=kept, cleanup_tmp_directories=True)

    def save(self, step: int, state: Any, iterator: dict[str, Any], measures: dict[str, float] | None = None) -> None:
        """Save the state after `step` steps with the position of the input pipeline and, at the end of an epoch, validation measures."""
        if self.last == step:
            return
        self._checkpointer.save(step, state, metrics=measures, custom_metadata={"iterator": iterator}, force=True)

    def restore_last(self, like: Any) -> tuple[Any, dict[str, Any]] | None:
        """Return the last state, typed and placed as the abstract `like`, and the pipeline's position; None without a checkpoint."""
        latest = read_checkpoint(f"{self._folder}", lambda: self._checkpointer.latest)
        if latest is None:
            return None
        where = f"{self._folder}, step {latest.step}"
        iterator = read_checkpoint(where, lambda: self._checkpointer.metadata(latest.step).custom_metadata["iterator"])
        return read_checkpoint(where, lambda: self._checkpointer.load(latest.step, like)), iterator

    @property
    def last(self) -> int | None:
        """The step of the last checkpoint, None without one."""
        latest = self._checkpointer.latest
        return None if latest is None else latest.step

    def close(self) -> None:
        """Finish writing."""
        self._checkpointer.close()


def write_config(run: Path, config: Config) -> None:
    """Write `config.json` into a run folder.

    Raises:
        ValueError: the folder has another config; the message names the flags that differ.
    """
    check_config(run, config)
    run.mkdir(parents=True, exist_ok=True)
    write_text(run / CONFIG, to_json(config))


def check_config(run: Path, config: Config) -> None:
    """Refuse a run folder that has another config; one without a config is accepted, and so are differences in `MAY_CHANGE`.

    Raises:
        ValueError: the message names the flags that differ.
    """
    path = run / CONFIG
    if path.exists() and (changed := [flag for flag in differences(read_config(run), config) if flag.split(":")[0] not in MAY_CHANGE]):
        raise ValueError(f"{path} has another config ({'; '.join(changed)}): continue with its flags, or choose another --name")
