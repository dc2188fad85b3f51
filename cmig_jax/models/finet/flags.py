"""Flags of FINet, whose defaults are the official sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from cmig_jax.config import Rule
from cmig_jax.models.regression_flags import RegressionFlags


@dataclass(frozen=True)
class FINetFlags(RegressionFlags):
    """The network and its losses. Sections of the paper are not named: its text was not at hand."""

    network: ClassVar[str] = "finet"
    title: ClassVar[str] = "FINet"

    encoder_widths: tuple[int, ...] = (64, 64, 128, 256, 512)
    """Channels of the layers of a branch's encoder; its features are the outputs of all of them."""
    exchange_after: tuple[int, ...] = (2, 4)
    """Layers, counted from 1, whose maximum over the points goes to the other cloud's next layer, without a gradient."""
    fusion_widths: tuple[int, ...] = (2048, 1024, 1024)
    """Channels of a branch's layers on the pooled features of both clouds."""
    sensitivity_weight: float = 0.001
    """Weight of the transformation sensitivity: a branch's features shall change under its own motion, and not under the other's; 0 turns
    it off."""
    sensitivity_margin: float = 0.01
    """Mean squared change of the features under a branch's own motion that suffices."""
    dropout_weight: float = 0.0025
    """Weight of the change of the pooled features when points are left out; 0 turns it off."""
    dropout: float = 0.3
    """Share of the points that are left out for that."""
    regularised: int = 2
    """First iterations that these two losses apply to."""

    def _rules(self) -> Iterator[Rule]:
        layers = len(self.encoder_widths)
        exchanged = all(1 <= i < layers for i in self.exchange_after)
        yield from super()._rules()
        yield f"model.exchange_after = {self.exchange_after}", exchanged, f"layers from 1 to {layers - 1}"
        yield f"model.sensitivity_weight = {self.sensitivity_weight}", self.sensitivity_weight >= 0, "0 (off) or more"
        yield f"model.sensitivity_margin = {self.sensitivity_margin}", self.sensitivity_margin >= 0, "0 or more"
        yield f"model.dropout_weight = {self.dropout_weight}", self.dropout_weight >= 0, "0 (off) or more"
        yield f"model.dropout = {self.dropout}", 0 <= self.dropout < 1, "a share in [0, 1)"
        yield f"model.regularised = {self.regularised}", self.regularised >= 0, "0 or more"
