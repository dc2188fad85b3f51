"""Batches of training pairs: a grain pipeline, seeded per item, sharded by process, resumed from its own small state."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from typing import Any, Protocol

import grain
import numpy as np
from absl import flags

from cmig_jax.config import Config
from cmig_jax.data.pairs import Pair, Pairs

TRAINING_KEYS = ("source", "target", "R", "t", "views", "source_normals", "target_normals")


class BatchIterator(Protocol):
    """An endless iterator of batches whose position can be saved and restored."""

    def __next__(self) -> Pair: ...
    def get_state(self) -> dict[str, Any]: ...
    def set_state(self, state: dict[str, Any]) -> None: ...


def training_batches(pairs: Pairs, config: Config, *, process: int = 0, processes: int = 1) -> BatchIterator:
    """Iterate over shuffled batches of freshly drawn pairs, without end; the last incomplete batch of an epoch is dropped.

    Args:
        pairs: pairs of the training objects.
        config: `optim.batch`, `seed` and `data.workers` are used.
        process, processes: index and number of processes, each of which makes its share of every batch.

    Returns:
        An iterator of dicts of arrays with a leading axis of `optim.batch / processes`.

    Raises:
        ValueError: a batch that the processes cannot share equally, or fewer objects than one batch.
    """
    batch = config.optim.batch
    if batch % processes:
        raise ValueError(f"optim.batch = {batch}: expected a multiple of the {processes} processes")
    if len(pairs) < batch:
        raise ValueError(f"optim.batch = {batch}: expected at most the {len(pairs)} training objects")
    data = grain.MapDataset.range(len(pairs)).seed(config.seed).shuffle()
    data = data.random_map(_with_seed).batch(batch, drop_remainder=True, batch_fn=list)
    data = data.map(_Draw(pairs, process, processes)).repeat()
    options = grain.ReadOptions(num_threads=0 if config.data.workers else 1, prefetch_buffer_size=2)
    stream = data.to_iter_dataset(options)
    if config.data.workers:
        if not flags.FLAGS.is_parsed():
            flags.FLAGS.mark_as_parsed()  # grain's workers read absl's flags, which no script of this package parses
        stream = stream.mp_prefetch(grain.MultiprocessingOptions(num_workers=config.data.workers), worker_init_fn=_ignore_interrupts)
    return iter(stream)


def epoch_steps(pairs: Pairs, config: Config) -> int:
    """Return the number of steps in one epoch."""
    return len(pairs) // config.optim.batch


def stack(pairs: Sequence[Pair]) -> Pair:
    """Stack pairs of equal shapes into a batch `[B, ...]` of the arrays that training reads."""
    return {key: np.stack([pair[key] for pair in pairs]) for key in TRAINING_KEYS if key in pairs[0]}


def _ignore_interrupts(worker: int, workers: int) -> None:
    """Leave Ctrl-C, which a terminal sends to every process, to the training, which then stops its workers."""
    del worker, workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _with_seed(position: int, rng: np.random.Generator) -> tuple[int, int]:
    return position, int(rng.integers(2**62))


class _Draw:
    """Draws this process's part of a batch; the pairs of a whole batch do not depend on the number of processes."""

    def __init__(self, pairs: Pairs, process: int, processes: int) -> None:
        self.pairs, self.process, self.processes = pairs, process, processes

    def __call__(self, batch: list[tuple[int, int]]) -> Pair:
        share = len(batch) // self.processes
        mine = batch[self.process * share : (self.process + 1) * share]
        return stack([self.pairs.draw(position, np.random.default_rng(seed)) for position, seed in mine])
