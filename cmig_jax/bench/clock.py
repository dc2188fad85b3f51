"""Time two ways of doing the same work in turns, so that whatever else the machine does meets both."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Work = Callable[[], Any]


@dataclass(frozen=True)
class Timing:
    """Medians over repetitions, seconds, and how far they spread (largest over smallest)."""

    pytorch: float
    ours: float
    spread: float

    def as_json(self) -> dict[str, float]:
        """Name the numbers; `ratio` is PyTorch over ours."""
        return {"ratio": self.pytorch / self.ours, "pytorch_s": self.pytorch, "ours_s": self.ours, "spread": self.spread}


def in_turns(pytorch: Work, ours: Work, repetitions: int) -> Timing:
    """Run both once unmeasured, then in turns."""
    pytorch()
    ours()
    times: tuple[list[float], list[float]] = ([], [])
    for _ in range(repetitions):
        for work, taken in zip((pytorch, ours), times, strict=True):
            start = time.perf_counter()
            work()
            taken.append(time.perf_counter() - start)
    spread = max(max(taken) / min(taken) for taken in times)
    return Timing(statistics.median(times[0]), statistics.median(times[1]), spread)
