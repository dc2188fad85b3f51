"""Flags of IDAM, whose defaults are the official sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cmig_jax.config import ModelFlags, Needs, check


@dataclass(frozen=True)
class IDAMFlags(ModelFlags):
    """Iterative distance-aware similarity matrix convolution with mutual-supervised point elimination."""

    network: ClassVar[str] = "idam"
    title: ClassVar[str] = "IDAM"

    k: int = 12
    """Neighbours in the graph of the coordinates, the point itself included (Sec. 4)."""
    layers: int = 5
    """Layers of the graph network (Sec. 4)."""
    dim: int = 64
    """Channels of the point features."""
    significance_widths: tuple[int, ...] = (64, 32)
    """Channels of the layers that score a point (Sec. 3.3)."""
    pair_width: int = 32
    """Channels of a pair of keypoints (Sec. 3.2)."""
    points_per_keypoint: int = 6
    """A cloud of N source points keeps K = floor(N / this) keypoints of each cloud (Sec. 3.3)."""
    iterations: int = 3
    """Iterations, each with its own weights (Sec. 3.2)."""
    match_threshold: float = 0.05
    """Two points correspond if they are closer than this under the true pose, object units."""
    credibility_label: Literal["index", "distance"] = "index"
    """Label of a correspondence's validity: it has the index of the true one (released code), or it is closer than `match_threshold`."""

    def __post_init__(self) -> None:
        check(
            [
                (f"model.k = {self.k}", self.k >= 1, "at least 1"),
                (f"model.layers = {self.layers}", self.layers >= 1, "at least 1"),
                (f"model.dim = {self.dim}", self.dim >= 1, "at least 1"),
                (
                    f"model.significance_widths = {self.significance_widths}",
                    min(self.significance_widths, default=0) > 0,
                    "one or more numbers above 0",
                ),
                (f"model.pair_width = {self.pair_width}", self.pair_width >= 1, "at least 1"),
                (f"model.points_per_keypoint = {self.points_per_keypoint}", self.points_per_keypoint >= 1, "at least 1"),
                (f"model.iterations = {self.iterations}", self.iterations >= 1, "at least 1"),
                (f"model.match_threshold = {self.match_threshold}", self.match_threshold > 0, "above 0"),
            ]
        )

    @property
    def needs(self) -> Needs:
        """Points enough for the graph and for three keypoints."""
        fewest = max(self.k, 3 * self.points_per_keypoint)
        return Needs(points=fewest, training_points=fewest)
