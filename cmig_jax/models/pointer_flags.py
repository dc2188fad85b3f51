"""Flags that the networks with pointers between the clouds share (DCP, PRNet)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from cmig_jax.config import ModelFlags, Rule, check

RoundTrip = Literal["off", "official", "consistent"]


@dataclass(frozen=True)
class PointerFlags(ModelFlags):
    """Flags of the features."""

    k: int = 20
    """Neighbours in the graph, the point itself included (Sec. 4.1 of DCP)."""
    widths: tuple[int, ...] = (64, 64, 128, 256)
    """Channels of the layers on the graph (Sec. 4.1)."""
    dim: int = 512
    """Channels of the point features (Sec. 4.1)."""
    heads: int = 4
    """Attention heads of the transformer between the clouds (Sec. 4.2)."""
    feed_forward: int = 1024
    """Hidden channels of its feed-forward layers (Sec. 4.2)."""

    def __post_init__(self) -> None:
        check(self._rules())

    def _rules(self) -> Iterator[Rule]:
        yield f"model.k = {self.k}", self.k >= 1, "at least 1"
        yield f"model.widths = {self.widths}", min(self.widths, default=0) > 0, "one or more numbers above 0"
        yield f"model.dim = {self.dim}", self.dim >= 2, "at least 2"
        yield f"model.heads = {self.heads}", self.heads >= 1 and self.dim % self.heads == 0, f"a divisor of model.dim = {self.dim}"
        yield f"model.feed_forward = {self.feed_forward}", self.feed_forward >= 1, "at least 1"
