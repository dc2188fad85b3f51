"""What an evaluation compares: methods without learning, the network, and the network's pose refined."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cmig_jax import baselines
from cmig_jax.evaluation.engine import Method, Pair, one_by_one
from cmig_jax.inference.load import Network
from cmig_jax.transform import RigidTransform, stack

Refinement = Callable[..., RigidTransform]
REFINEMENTS: dict[str, Refinement] = {"ICP": baselines.refine_by_icp, "GICP": baselines.refine_by_gicp}


def methods_for(network: Network) -> dict[str, Method]:
    """Return the methods by the name of their row; a network's rows begin with its title."""
    rows = {name: one_by_one(method.register) for name, method in baselines.classical(network.config.data).items()}
    rows[network.title] = lambda pairs: network([dict(pair) for pair in pairs])
    return rows | {refined_row(network.title, name): _refined(network, refine) for name, refine in REFINEMENTS.items()}


def refined_row(title: str, refinement: str) -> str:
    """Return the name of the row of a network with a refinement."""
    return f"{title} + {refinement}"


def settings_for(network: Network) -> dict[str, Any]:
    """Return the settings of all methods but the network, as JSON values."""
    return {
        "baselines": {name: method.settings for name, method in baselines.classical(network.config.data).items()},
        "refinement": baselines.CUTOFFS,
    }


def _refined(network: Network, refine: Refinement) -> Method:
    def method(pairs: list[Pair]) -> RigidTransform:
        starts = network([dict(pair) for pair in pairs])
        return stack([refine(pair["source"], pair["target"], starts[i]) for i, pair in enumerate(pairs)])

    return method
