"""Learned rigid registration of two partial point clouds, in JAX and Flax; CMIGNet (Xie et al., RA-L 2023) is the flagship network.

`register` aligns two clouds and says whether the result, a `Registration`, can be trusted; `cmig register` does the same for two files.
`register_sequence` finds the poses of several scans of one scene.
`load` reads a trained network from a run folder or a weights file. `Config` holds the flags of a run, `RigidTransform` is the pose.
`docs/architecture.md` describes the package.
"""

from typing import TYPE_CHECKING, Any

from cmig_jax.config import Config

if TYPE_CHECKING:
    from cmig_jax.inference.load import Network, load
    from cmig_jax.registration.register import register
    from cmig_jax.registration.result import Registration
    from cmig_jax.registration.sequence import register_sequence
    from cmig_jax.transform import RigidTransform

__all__ = ["Config", "Network", "Registration", "RigidTransform", "load", "register", "register_sequence"]


def __getattr__(name: str) -> Any:
    """Import what needs JAX only when it is used: the loader's processes import this package too."""
    if name in ("Network", "load"):
        from cmig_jax.inference import load as module
    elif name == "register":
        from cmig_jax.registration import register as module
    elif name == "register_sequence":
        from cmig_jax.registration import sequence as module
    elif name == "Registration":
        from cmig_jax.registration import result as module
    elif name == "RigidTransform":
        from cmig_jax import transform as module
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(module, name)
