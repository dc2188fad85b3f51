"""A network behind MaskNet: it registers the source with the target points that MaskNet chooses (Sarode et al., 3DV 2020)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import flax.linen as nn
from jax import Array

from cmig_jax.inference.load import Network
from cmig_jax.inference.predictor import Predictor
from cmig_jax.models.masknet.flags import MaskNetFlags
from cmig_jax.models.masknet.network import MaskNet, masked
from cmig_jax.models.networks import model_of
from cmig_jax.structs import Batch, Prediction


class Masked(nn.Module):
    """MaskNet, and another network on what it leaves."""

    mask: MaskNet
    network: nn.Module

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> Prediction:
        """Predict the poses of a batch in evaluation mode."""
        assert not train, "the two networks are trained one at a time"
        return self.network(masked(self.mask(batch, train=False), batch), train=False, key=key)


@dataclass(frozen=True)
class MaskedNetwork(Network):
    """A trained network behind a trained MaskNet."""

    mask: Network

    @property
    def title(self) -> str:
        """Its name in tables and pictures."""
        return f"MaskNet, then {super().title}"


def behind_mask(network: Network, mask: Network) -> MaskedNetwork:
    """Put a trained MaskNet in front of another trained network.

    Args:
        network: what registers; the result has its config.
        mask: a MaskNet.

    Raises:
        ValueError: `mask` is another network, or `network` matches points of one cloud with those of the other by index.
    """
    flags = mask.config.model
    if not isinstance(flags, MaskNetFlags):
        raise ValueError(f"mask: a network {flags.network}, expected masknet")
    if network.config.model.needs.equal_sizes:
        raise ValueError(f"{network.title} needs clouds of equal size: expected a network that takes what MaskNet leaves of the target")
    model = model_of(network.config.model)
    module = Masked(MaskNet(flags, mask.config.compute), model.build(network.config.model, network.config.compute))
    parts = {"mask": mask.variables, "network": network.variables}
    variables: dict[str, Any] = {kind: {name: part.get(kind, {}) for name, part in parts.items()} for kind in ("params", "batch_stats")}
    return MaskedNetwork(network.config, variables, Predictor(module, network.predictor.batch), network.step, mask)
