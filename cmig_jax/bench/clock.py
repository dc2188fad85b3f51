"""Time several ways of doing the same work in turns, so that whatever else the machine does meets all of them."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass

OURS, PYTORCH, KEPT = "ours", "pytorch", "pytorch_kept"


@dataclass(frozen=True)
class Timing:
    """Median seconds of each over the repetitions, and how far they spread (largest over smallest)."""

    medians: Mapping[str, float]
    spread: float

    def as_json(self) -> dict[str, float]:
        """Name the numbers; `ratio` is PyTorch, as it is installed, over ours, and `ratio_kept` PyTorch with freed memory kept."""
        ratios = {"ratio": PYTORCH, "ratio_kept": KEPT}
        known = {name: self.medians[who] / self.medians[OURS] for name, who in ratios.items() if who in self.medians}
        return known | {f"{who}_s": seconds for who, seconds in self.medians.items()} | {"spread": self.spread}


def in_turns(works: Mapping[str, Callable[[], float]], repetitions: int) -> Timing:
    """Run all in turns; each returns the seconds that it took."""
    times: dict[str, list[float]] = {who: [] for who in works}
    for _ in range(repetitions):
        for who, work in works.items():
            times[who].append(work())
    spread = max(max(taken) / min(taken) for taken in times.values())
    return Timing({who: statistics.median(taken) for who, taken in times.items()}, spread)
