"""Flags of PointNetLK and PointNetLK Revisited."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

from cmig_jax.config import ModelFlags, Needs, check


@dataclass(frozen=True)
class PointNetLKFlags(ModelFlags):
    """PointNetLK ("Aoki": CVPR 2019) and what PointNetLK Revisited ("Li": CVPR 2021) changes."""

    network: ClassVar[str] = "pointnetlk"
    title: ClassVar[str] = "PointNetLK"

    widths: tuple[int, ...] = (64, 64, 64, 128, 1024)
    """Channels of the encoder's layers (Aoki, Sec. 3.1); Li: 64 128 1024."""
    jacobian: Literal["difference", "analytic"] = "difference"
    """Derivative of the target's features by the twist: backward differences (Aoki, Eq. 6), or exact (Li, Sec. 3.2)."""
    step: float = 0.01
    """Step of the backward differences: radians for the rotations, object units for the translations (Aoki, Sec. 3.2)."""
    learn_jacobian: bool = True
    """Whether the loss also learns through the Jacobian and its pseudo-inverse; Li's released code holds them constant."""
    iterations: int = 10
    """Iterations in training (released code)."""
    test_iterations: int = 10
    """Iterations in evaluation; Li's released code takes 20."""
    training_points: int = 0
    """Random points that features, Jacobian and residuals are computed from in training, and as many others that update the running
    statistics; 0 takes all. Li's released code takes 100."""
    residual_loss: Literal["last", "change"] = "last"
    """Loss on the features: the last residual (Aoki, Sec. 3.3), or its difference from the one before (Li's released code)."""

    def __post_init__(self) -> None:
        check(
            [
                (f"model.widths = {self.widths}", min(self.widths, default=0) >= 1 and self.widths[-1] >= 6, "channels, at last 6 or more"),
                (f"model.step = {self.step}", 0 < self.step < 1, "a step in (0, 1)"),
                (f"model.iterations = {self.iterations}", self.iterations >= 1, "at least 1"),
                (f"model.test-iterations = {self.test_iterations}", self.test_iterations >= 1, "at least 1"),
                (f"model.training-points = {self.training_points}", self.training_points >= 0, "0 (all) or a number of points"),
            ]
        )

    @property
    def needs(self) -> Needs:
        """As many points in training as are drawn."""
        return Needs(training_points=max(3, self.training_points))


def revisited(flags: PointNetLKFlags = PointNetLKFlags()) -> PointNetLKFlags:
    """Return flags with the changes of PointNetLK Revisited, as released."""
    return replace(
        flags,
        widths=(64, 128, 1024),
        jacobian="analytic",
        learn_jacobian=False,
        test_iterations=20,
        training_points=100,
        residual_loss="change",
    )
