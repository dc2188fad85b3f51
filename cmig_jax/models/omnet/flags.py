"""Flags of OMNet, whose defaults are the official sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from cmig_jax.config import Rule
from cmig_jax.models.regression_flags import RegressionFlags


@dataclass(frozen=True)
class OMNetFlags(RegressionFlags):
    """The network and its losses. Sections of the paper are not named: its text was not at hand."""

    network: ClassVar[str] = "omnet"
    title: ClassVar[str] = "OMNet"

    local_widths: tuple[int, ...] = (64, 64)
    """Channels of the encoder's first layers; their output is the local feature of a point."""
    global_widths: tuple[int, ...] = (64, 128, 1024)
    """Channels of the encoder's further layers, whose maximum over the points is the global feature of a cloud."""
    fusion_widths: tuple[int, ...] = (1024, 1024, 512)
    """Channels of the layers on the local feature and both global features."""
    decoder_widths: tuple[int, ...] = (512, 256, 256)
    """Channels of the mask decoder before its two logits."""
    unmasked: int = 2
    """Iterations that see all points; the later ones see those that the iteration before has classified as overlapping (official: 2)."""
    overlap_threshold: float = 0.1
    """A point overlaps if the other cloud has a point closer than this under the true pose, object units."""
    class_weights: tuple[float, float] = (0.7, 0.3)
    """Weights of points without and with overlap in the classification loss."""

    def _rules(self) -> Iterator[Rule]:
        yield from super()._rules()
        yield f"model.unmasked = {self.unmasked}", self.unmasked >= 1, "at least 1"
        yield f"model.overlap_threshold = {self.overlap_threshold}", self.overlap_threshold > 0, "above 0"
        yield f"model.class_weights = {self.class_weights}", min(self.class_weights) > 0, "two weights above 0"
