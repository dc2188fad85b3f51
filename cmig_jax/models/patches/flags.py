"""Flags of the patch transformer, whose defaults are those of the network that comes with the package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cmig_jax.config import ModelFlags, Needs, check


@dataclass(frozen=True)
class PatchFlags(ModelFlags):
    """A few points of each cloud with what lies around them, a transformer between the two sets, and a pose from soft correspondences."""

    network: ClassVar[str] = "patches"
    title: ClassVar[str] = "Patch transformer"

    k: int = 16
    """Points of a patch, its centre included: the nearest of the cloud."""
    patch_widths: tuple[int, ...] = (64, 128)
    """Channels of the layers on the points of a patch."""
    dim: int = 128
    """Channels of a patch's feature."""
    layers: int = 4
    """Layers of the transformer, each with attention within a cloud and to the other."""
    heads: int = 4
    """Attention heads."""
    feed_forward: int = 256
    """Hidden channels of its feed-forward layers."""
    patches: int = 64
    """Patches of each cloud in training, around random points; fewer where a cloud has fewer points."""
    test_patches: int = 384
    """Patches of each cloud in evaluation."""
    passes: int = 4
    """Passes in evaluation, each on the source as the ones before have moved it; training has one."""
    image: Literal["none", "pixels", "views"] = "none"
    """What patches read of the depth views of their cloud (`views.of=both`, `views.layout=axes`): nothing; the features of the pixels that
    their centres fall on, where visible; or by attention one feature per view, as CMIGNet's `fusion.image=views`. Views are of the source
    as it is given, in every pass."""
    near: float = 0.15
    """Two patches correspond if their centres are closer than this under the true pose, object units."""
    offset_weight: float = 5.0
    """Weight of the loss of the distance between soft and true correspondents."""

    def __post_init__(self) -> None:
        check(
            [
                (f"model.k = {self.k}", self.k >= 1, "at least 1"),
                (f"model.patch_widths = {self.patch_widths}", min(self.patch_widths, default=0) >= 1, "one or more numbers above 0"),
                (
                    f"model.dim = {self.dim} with model.heads = {self.heads}",
                    self.heads >= 1 and self.dim >= 1 and self.dim % self.heads == 0,
                    "a multiple of the heads, at least 1 of them",
                ),
                (f"model.layers = {self.layers}", self.layers >= 1, "at least 1"),
                (f"model.feed_forward = {self.feed_forward}", self.feed_forward >= 1, "at least 1"),
                (f"model.patches = {self.patches}", self.patches >= 3, "at least 3"),
                (f"model.test_patches = {self.test_patches}", self.test_patches >= 3, "at least 3"),
                (f"model.passes = {self.passes}", self.passes >= 1, "at least 1"),
                (f"model.near = {self.near}", self.near > 0, "above 0"),
                (f"model.offset_weight = {self.offset_weight}", self.offset_weight >= 0, "0 or more"),
            ]
        )

    @property
    def needs(self) -> Needs:
        """The points of a patch, three patches for a pose, and maybe views."""
        return Needs(points=max(3, self.k), training_points=max(3, self.k), views=self.image != "none", axis_views=self.image != "none")
