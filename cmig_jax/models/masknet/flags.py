"""Flags of MaskNet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cmig_jax.config import ModelFlags, check

FEWEST = 3  # points that a pose needs


@dataclass(frozen=True)
class MaskNetFlags(ModelFlags):
    """MaskNet (Sarode et al., 3DV 2020), and the ICP behind it."""

    network: ClassVar[str] = "masknet"
    title: ClassVar[str] = "MaskNet + ICP"

    widths: tuple[int, ...] = (64, 64, 64, 128, 1024)
    """Channels of the encoder's layers (Sec. 3.1)."""
    mask_widths: tuple[int, ...] = (1024, 512, 256, 128)
    """Channels of the layers that score a point, before the last (Sec. 3.1)."""
    share: float = 0.0
    """Share of the target's points that is chosen; 0: as many as the source has, so that nothing is left out where both clouds have equal
    size. The released code takes as many as the source has."""
    loss: Literal["mse", "bce"] = "mse"
    """Mean squared error of the mask (released code's default), or binary cross-entropy."""
    overlap_threshold: float = 0.05
    """A target point is labelled 1 if a source point lies within this distance under the true pose, object units. The released code labels
    the very points that its crop of the source kept, which needs one sampling for both clouds."""
    icp_iterations: int = 20
    """Iterations of ICP, from equal centroids and no rotation, between the source and the chosen points."""

    def __post_init__(self) -> None:
        check(
            [
                (f"model.widths = {self.widths}", min(self.widths, default=0) >= 1, "one or more numbers of channels"),
                (f"model.mask-widths = {self.mask_widths}", min(self.mask_widths, default=0) >= 1, "one or more numbers of channels"),
                (f"model.share = {self.share}", 0 <= self.share <= 1, "0 (as many as the source has) or a share of at most 1"),
                (f"model.overlap-threshold = {self.overlap_threshold}", self.overlap_threshold > 0, "a distance above 0"),
                (f"model.icp-iterations = {self.icp_iterations}", self.icp_iterations >= 1, "at least 1"),
            ]
        )

    def chosen(self, source_points: int, target_points: int) -> int:
        """Return how many of the target's points are chosen."""
        return max(FEWEST, round(self.share * target_points)) if self.share else min(source_points, target_points)
