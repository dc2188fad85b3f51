"""Flags that the networks with a regressed pose share (OMNet, FINet)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from cmig_jax.config import ModelFlags, Needs, Rule, check


@dataclass(frozen=True)
class RegressionFlags(ModelFlags):
    """What OMNet and FINet have in common: iterations that regress a pose, and the loss of the pose."""

    iterations: int = 4
    """Iterations, each with its own weights."""
    regression_widths: tuple[int, ...] = (2048, 1024, 512, 256)
    """Channels of the layers that regress the pose, before the last."""
    translation_weight: float = 4.0
    """Weight of the translation's squared error beside the quaternion's absolute error."""
    quaternion_sign: Literal["positive", "nearer"] = "positive"
    """True quaternion that the loss compares with: the one with w >= 0 (official), or of q and -q the nearer one."""

    def __post_init__(self) -> None:
        check(self._rules())

    @property
    def needs(self) -> Needs:
        """Two pairs to train with: the regression normalises over the pairs of a batch."""
        return Needs(pairs=2)

    def _rules(self) -> Iterator[Rule]:
        yield f"model.iterations = {self.iterations}", self.iterations >= 1, "at least 1"
        yield f"model.translation_weight = {self.translation_weight}", self.translation_weight >= 0, "0 or more"
        for name, value in vars(self).items():
            if name.endswith("widths"):
                yield f"model.{name} = {value}", len(value) > 0 and min(value) > 0, "one or more numbers above 0"
