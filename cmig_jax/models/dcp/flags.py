"""Flags of DCP, whose defaults are the official sizes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from cmig_jax.config import Needs
from cmig_jax.models.pointer_flags import PointerFlags, RoundTrip


@dataclass(frozen=True)
class DCPFlags(PointerFlags):
    """The network (Fig. 2 of its paper) and its losses; the defaults are DCP v2 as its authors trained it.

    One graph, of the coordinates, serves all layers on it (Sec. 4.1): the official code does not build the new graphs of the paper.
    """

    network: ClassVar[str] = "dcp"
    title: ClassVar[str] = "DCP"

    pointer: Literal["transformer", "identity"] = "transformer"
    """What is added to the features: the transformer's result (v2, Sec. 4.2), or themselves (v1). The doubled features of v1 are the
    official code's: they multiply the similarities by 4."""
    cycle: RoundTrip = "off"
    """Loss of the way from the source to the target and back: none (as trained officially), the official code's, or a consistent one. The
    official term for the translation is `R_back^T t + t_back`, which is not 0 for inverse poses; the consistent one is
    `R_back t + t_back`."""

    @property
    def needs(self) -> Needs:
        """Neighbours, and three points for a pose."""
        return Needs(points=max(3, self.k), training_points=max(3, self.k))
