"""What an evaluation compares: methods without learning, the network, and the network's pose refined."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

from numpy.typing import ArrayLike

from cmig_jax import baselines
from cmig_jax.data.protocol import largest_rotation_deg
from cmig_jax.evaluation.engine import Method, Pair, one_by_one
from cmig_jax.inference.load import Network
from cmig_jax.registration.register import register
from cmig_jax.transform import RigidTransform, stack

Refinement = Callable[..., RigidTransform]
REFINEMENTS: dict[str, Refinement] = {"ICP": baselines.refine_by_icp, "GICP": baselines.refine_by_gicp}
Search = Literal["any", "bound"]


def methods_for(network: Network, search: Sequence[Search] = ()) -> dict[str, Method]:
    """Return the methods by the name of their row; a network's rows begin with its title.

    Args:
        network: with the flags of the test in its config.
        search: rows of `register`: at any rotation, and within the largest of the protocol.
    """
    limits = search_limits(network, search)
    rows = {name: one_by_one(functools.partial(_registered, rotations=limit)) for name, limit in limits.items()}
    rows |= {name: one_by_one(method.register) for name, method in baselines.classical(network.config.data).items()}
    rows[network.title] = lambda pairs: network([dict(pair) for pair in pairs])
    return rows | {refined_row(network.title, name): _refined(network, refine) for name, refine in REFINEMENTS.items()}


def refined_row(title: str, refinement: str) -> str:
    """Return the name of the row of a network with a refinement."""
    return f"{title} + {refinement}"


def search_limits(network: Network, search: Sequence[Search]) -> dict[str, Any]:
    """Return what `register` is told about the rotation, by the name of the row."""
    bound = round(largest_rotation_deg(network.config.data), 1)
    return {"register" if which == "any" else f"register (within {bound:g} deg)": "any" if which == "any" else bound for which in search}


def settings_for(network: Network, search: Sequence[Search] = ()) -> dict[str, Any]:
    """Return the settings of all methods but the network, as JSON values."""
    return {
        **({"register": search_limits(network, search)} if search else {}),
        "baselines": {name: method.settings for name, method in baselines.classical(network.config.data).items()},
        "refinement": baselines.CUTOFFS,
    }


def _registered(source: ArrayLike, target: ArrayLike, rotations: Any) -> RigidTransform:
    return register(source, target, rotations=rotations).target_from_source


def _refined(network: Network, refine: Refinement) -> Method:
    def method(pairs: list[Pair]) -> RigidTransform:
        starts = network([dict(pair) for pair in pairs])
        return stack([refine(pair["source"], pair["target"], starts[i]) for i, pair in enumerate(pairs)])

    return method
