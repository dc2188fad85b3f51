"""CMIGNet (Xie et al., RA-L 2023) in JAX and Flax: rigid registration of two partial point clouds, guided by depth images.

`load` reads a trained network from a run folder and `register` aligns two clouds with it, `python -m cmig_jax.align` two files;
`Config` holds the flags of a run.
`data` makes pairs (numpy only), `nn` is the network, `geometry` the pose solver and neighbours, `losses` and `metrics` judge a
prediction, `training` brings them together, `evaluation` compares methods, `parity` compares numbers with PyTorch.
"""

from typing import TYPE_CHECKING, Any

from cmig_jax.config import Config

if TYPE_CHECKING:
    from cmig_jax.registration import Network, load, register
    from cmig_jax.structs import RigidTransform

__all__ = ["Config", "Network", "RigidTransform", "load", "register"]


def __getattr__(name: str) -> Any:
    """Import what needs JAX only when it is asked for: the loader's processes import this package too."""
    if name in ("Network", "load", "register"):
        from cmig_jax import registration

        return {"Network": registration.Network, "load": registration.load, "register": registration.register}[name]
    if name == "RigidTransform":
        from cmig_jax.structs import RigidTransform

        return RigidTransform
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
