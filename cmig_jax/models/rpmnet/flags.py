"""Flags of RPM-Net, whose defaults are the official sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cmig_jax.config import ModelFlags, Needs, check

GROUPS, WIDE_GROUPS = 8, 16  # of the normalisations; wide: the last layer before the maximum of the parameter net, and those after it


@dataclass(frozen=True)
class RPMNetFlags(ModelFlags):
    """RPM-Net: soft matching of local features with annealing parameters from a network."""

    network: ClassVar[str] = "rpmnet"
    title: ClassVar[str] = "RPM-Net"

    radius: float = 0.3
    """Radius of a point's neighbourhood, object units (Sec. 5.1)."""
    neighbours: int = 64
    """Most neighbours per point, itself left out; a point with fewer repeats itself."""
    neighbours_by: Literal["index", "nearest"] = "index"
    """Which points of a full neighbourhood are taken: the first by index (official; clouds have a random order), or the nearest."""
    dim: int = 96
    """Channels of a point's feature; the layers before have this many or twice as many (Sec. 5.1)."""
    parameter_widths: tuple[int, ...] = (64, 64, 64, 128, 1024)
    """Channels of the parameter net before the maximum over the points of both clouds (Sec. 5.3)."""
    parameter_head: tuple[int, ...] = (512, 256)
    """Channels of the parameter net after that maximum."""
    iterations: int = 2
    """Iterations in training (Sec. 5.5)."""
    test_iterations: int = 5
    """Iterations in evaluation (Sec. 5.5), with the same weights."""
    sinkhorn_rounds: int = 5
    """Normalisations of rows and columns per iteration (Sec. 5.2)."""
    discount: float = 0.5
    """Factor of an iteration's loss for each iteration after it (Eq. 12)."""
    outlier_weight: float = 0.01
    """Weight of the loss that keeps points from being left without a partner (Eq. 11)."""

    def __post_init__(self) -> None:
        *narrow, last = self.parameter_widths or (0,)
        divisible = all(width >= GROUPS and width % GROUPS == 0 for width in narrow)
        wide, wide_head = (all(w >= WIDE_GROUPS and w % WIDE_GROUPS == 0 for w in widths) for widths in ((last,), self.parameter_head))
        check(
            [
                (f"model.radius = {self.radius}", self.radius > 0, "above 0"),
                (f"model.neighbours = {self.neighbours}", self.neighbours >= 1, "at least 1"),
                (f"model.dim = {self.dim}", self.dim >= GROUPS and self.dim % GROUPS == 0, f"a multiple of {GROUPS}"),
                (
                    f"model.parameter_widths = {self.parameter_widths}",
                    divisible and wide,
                    f"multiples of {GROUPS}, the last one of {WIDE_GROUPS}",
                ),
                (f"model.parameter_head = {self.parameter_head}", wide_head, f"multiples of {WIDE_GROUPS}"),
                (f"model.iterations = {self.iterations}", self.iterations >= 1, "at least 1"),
                (f"model.test_iterations = {self.test_iterations}", self.test_iterations >= 1, "at least 1"),
                (f"model.sinkhorn_rounds = {self.sinkhorn_rounds}", self.sinkhorn_rounds >= 0, "0 or more"),
                (f"model.discount = {self.discount}", 0 < self.discount <= 1, "a factor in (0, 1]"),
                (f"model.outlier_weight = {self.outlier_weight}", self.outlier_weight >= 0, "0 or more"),
            ]
        )

    @property
    def needs(self) -> Needs:
        """Unit normals."""
        return Needs(normals=True)
