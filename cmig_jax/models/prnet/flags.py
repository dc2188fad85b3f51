"""Flags of PRNet, whose defaults are the official sizes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar, Literal

from cmig_jax.config import Needs, Rule
from cmig_jax.models.pointer_flags import PointerFlags, RoundTrip


@dataclass(frozen=True)
class PRNetFlags(PointerFlags):
    """The network (Fig. 2 of its paper) and its losses; the defaults are the official ones.

    Each layer on a graph reads the output of the one before, and has a new graph of it; activations are leaky ReLUs.
    """

    network: ClassVar[str] = "prnet"
    title: ClassVar[str] = "PRNet"

    keypoints: int = 512
    """Keypoints K of each cloud: the points with the largest features (section "Keypoint Detection")."""
    test_keypoints: int = 0
    """Keypoints in evaluation, at most all points; 0: as in training."""
    matching: Literal["gumbel", "softmax"] = "gumbel"
    """`gumbel`: one partner per keypoint, drawn by Gumbel noise ("Gumbel-Softmax Sampler"); the derivative is that of the softmax of
    (similarity + noise) / temperature. It is drawn in evaluation too, as officially; without a key from a fixed one, and alike for all
    pairs, so that results repeat. `softmax`: the mean of all under the softmax of similarity * temperature (the official option
    multiplies)."""
    iterations: int = 3
    """Iterations, all with the same weights ("Actor-Critic Closest Point")."""
    discount: float = 0.9
    """Factor of the losses from one iteration to the next ("Loss Functions")."""
    feature_weight: float = 0.1
    """Weight of the distance between the mean features of the two clouds' keypoints ("Loss Functions")."""
    cycle: RoundTrip = "official"
    """Loss of the way from the source to the target and back: the official code's, a consistent one, or none. The official term for the
    translation is `t + t_back`, which is not 0 for inverse poses; the consistent one is `R t_back + t`."""
    cycle_weight: float = 0.1
    """Weight of the loss of the cycle ("Loss Functions")."""

    def _rules(self) -> Iterator[Rule]:
        tests = self.test_keypoints
        yield from super()._rules()
        yield f"model.keypoints = {self.keypoints}", self.keypoints >= 3, "at least 3"
        yield f"model.test_keypoints = {tests}", tests == 0 or tests >= 3, "0 (as in training), or at least 3"
        yield f"model.iterations = {self.iterations}", self.iterations >= 1, "at least 1"
        yield f"model.discount = {self.discount}", 0 < self.discount <= 1, "a factor in (0, 1]"
        yield f"model.feature_weight = {self.feature_weight}", self.feature_weight >= 0, "0 or more"
        yield f"model.cycle_weight = {self.cycle_weight}", self.cycle_weight >= 0, "0 or more"

    @property
    def needs(self) -> Needs:
        """Neighbours, keypoints, and two pairs in training for the batch statistics of the temperature."""
        return Needs(points=max(3, self.k), training_points=max(self.k, self.keypoints), pairs=2)
