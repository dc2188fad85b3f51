"""Many registrations at once, in threads. small_gicp computes inside Python's lock, so two threads use 1.3 cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def as_they_finish(function: Callable[[Item], Result], items: Sequence[Item]) -> Iterator[tuple[int, Result]]:
    """Yield the position of each item and what the function returns for it, in the order in which they finish.

    As many threads as cores run the function. On an error or Ctrl-C, items that have not begun are left out.
    """
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        positions = {pool.submit(function, item): i for i, item in enumerate(items)}
        for future in as_completed(positions):
            yield positions.pop(future), future.result()
    finally:
        pool.shutdown(cancel_futures=True)
