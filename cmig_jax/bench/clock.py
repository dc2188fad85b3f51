"""Time several ways of doing the same work in turns, so that whatever else the machine does meets all of them."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass

OURS, PYTORCH, KEPT = "ours", "pytorch", "pytorch_kept"


@dataclass(frozen=True)
class Timing:
    """Median seconds of each over the repetitions, without those whose work does not fit into memory, and how far they spread.

    The spread is the largest time over the smallest of one network, 1 where there is none.
    """

    medians: Mapping[str, float]
    spread: float

    def __or__(self, other: Timing) -> Timing:
        return Timing({**self.medians, **other.medians}, max(self.spread, other.spread))

    def as_json(self) -> dict[str, float]:
        """Name the numbers; `ratio` is PyTorch over ours, `ratio_kept` PyTorch that keeps its memory over ours."""
        ratios = {"ratio": PYTORCH, "ratio_kept": KEPT}
        known = {name: self.medians[who] / self.medians[OURS] for name, who in ratios.items() if {who, OURS} <= self.medians.keys()}
        return known | {f"{who}_s": seconds for who, seconds in self.medians.items()} | {"spread": self.spread}


def in_turns(works: Mapping[str, Callable[[], float | None]], repetitions: int) -> Timing:
    """Run all in turns; each returns the seconds that it took, or None if it does not fit into memory, and is then left out."""
    times: dict[str, list[float]] = {who: [] for who in works}
    for _ in range(repetitions):
        for who in list(times):
            seconds = works[who]()
            if seconds is None:
                del times[who]
            else:
                times[who].append(seconds)
    spread = max((max(taken) / min(taken) for taken in times.values()), default=1.0)
    return Timing({who: statistics.median(taken) for who, taken in times.items()}, spread)
