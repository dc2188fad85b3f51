"""Several processes that train as one: joining, taking turns, agreeing when to stop. With one process all of it does nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh

from cmig_jax.devices import replicated, split

T = TypeVar("T")
SHUTDOWN_SECONDS = 60  # how long a process that ends with an error waits for the others before JAX ends them


def join(coordinator: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Make this process one of several; to be called before JAX looks for devices.

    Args:
        coordinator: HOST:PORT where process 0 listens; by default what SLURM, Open MPI or the TPU pod says, as for the others.
        processes: how many there are.
        process: which of them this is, from 0.

    Raises:
        ValueError: neither arguments nor a launcher that JAX knows, or a process that is not among `processes`.
    """
    jax.config.update("jax_enable_preemption_service", False)  # it would intercept SIGTERM
    try:
        jax.distributed.initialize(coordinator, processes, process, shutdown_timeout_seconds=SHUTDOWN_SECONDS)
    except ValueError as error:
        given = f"--coordinator {coordinator} --processes {processes} --process {process}"
        raise ValueError(f"{given}: expected HOST:PORT, a count and an index below it, or to be started by a launcher ({error})") from error
    multihost_utils.sync_global_devices("joined")  # on CPUs the first synchronisation has a limit of 30 seconds, later ones have none


def is_first() -> bool:
    """Return whether this is the process that writes and prints."""
    return jax.process_index() == 0


def in_turn(work: Callable[[], T]) -> T:
    """Do the same work in every process, in the first before the others, which may then find its files.

    Raises:
        ValueError: the work failed in another process, so that none waits for one that has ended. A ValueError or OSError of this
            process's own work is raised as it is.
    """
    if jax.process_count() == 1:
        return work()
    results: list[T] = []
    for firsts_turn in (True, False):
        error: Exception | None = None
        if is_first() == firsts_turn:
            try:
                results.append(work())
            except (ValueError, OSError) as raised:
                error = raised
        failed = np.flatnonzero(multihost_utils.process_allgather(np.asarray(error is not None)))
        if error is not None:
            raise error
        if len(failed):
            raise ValueError(f"process {failed[0]} of {jax.process_count()} could not start; its output says why")
    return results[0]


class StopVote:
    """Whether any process was asked to stop. All must stop after the same step: in the next, each would wait for the others.

    The devices count the votes after the step's work, and the host reads them while the next step runs, so that devices never wait for
    the host. A single process decides at once.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._count = jax.jit(jnp.any, in_shardings=split(mesh), out_shardings=replicated(mesh))
        self._last: jax.Array | None = None

    def __call__(self, mine: bool) -> bool:
        """Cast the vote of this process at the end of a step; return the outcome of the step before."""
        if jax.process_count() == 1:
            return mine
        last, votes = self._last, np.full(len(self._mesh.local_devices), mine)
        self._last = self._count(jax.make_array_from_process_local_data(split(self._mesh), votes))
        return last is not None and bool(last)
