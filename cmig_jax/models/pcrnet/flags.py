"""Flags of PCRNet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from cmig_jax.config import ModelFlags, check


@dataclass(frozen=True)
class PCRNetFlags(ModelFlags):
    """Iterative PCRNet (Sarode et al., 2019)."""

    network: ClassVar[str] = "pcrnet"
    title: ClassVar[str] = "PCRNet"

    widths: tuple[int, ...] = (64, 64, 64, 128, 1024)
    """Channels of the encoder's layers (Sec. 3.1)."""
    head_widths: tuple[int, ...] = (1024, 1024, 512, 512, 256)
    """Channels of the layers that regress the pose, before the last (released code)."""
    iterations: int = 8
    """Times that the source is moved by a regressed pose (Sec. 3.2)."""
    from_identity: bool = False
    """Add (1, 0, 0, 0) to the regressed quaternion, so that an untrained network moves little; the released code does not."""

    def __post_init__(self) -> None:
        check(
            [
                (f"model.widths = {self.widths}", min(self.widths, default=0) >= 1, "one or more numbers of channels"),
                (f"model.head-widths = {self.head_widths}", min(self.head_widths, default=1) >= 1, "numbers of channels"),
                (f"model.iterations = {self.iterations}", self.iterations >= 1, "at least 1"),
            ]
        )
