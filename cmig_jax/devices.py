"""Devices: a mesh of one axis, the batch split over it, everything else on every device; NumPy batches become JAX arrays here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform


def device_mesh(batch: int, devices: int | None = None) -> Mesh:
    """Return a mesh over the devices that share batches of `batch` pairs.

    Args:
        batch: pairs per step, over all devices.
        devices: how many to use; by default the most that divide the batch (of several processes: all).

    Raises:
        ValueError: a batch that does not divide over all devices of several processes, or a number of devices that does not divide the
            batch or exceeds those there are.
    """
    available = jax.device_count()
    if devices is None:
        devices = max(n for n in range(1, available + 1) if batch % n == 0)
    if not 1 <= devices <= available or batch % devices:
        raise ValueError(f"{devices} devices: expected a divisor of the batch of {batch} pairs, at most {available}")
    if jax.process_count() > 1 and devices != available:
        raise ValueError(f"optim.batch = {batch}: expected a multiple of the {available} devices of {jax.process_count()} processes")
    # By process, so that each holds a block of consecutive pairs: the share that its loader makes.
    chosen = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))[:devices]
    return Mesh(np.array(chosen), ("batch",), axis_types=(AxisType.Auto,))


def replicated(mesh: Mesh) -> NamedSharding:
    """Return the sharding of the state: whole on every device."""
    return NamedSharding(mesh, PartitionSpec())


def split(mesh: Mesh) -> NamedSharding:
    """Return the sharding of a batch: its first axis over the devices."""
    return NamedSharding(mesh, PartitionSpec("batch"))


@contextmanager
def sharing(mesh: Mesh | None) -> Iterator[None]:
    """Tell the code that is traced inside that the devices of a mesh share the batch (`ops.neighbours.top_k`)."""
    with nullcontext() if mesh is None else jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
        yield


def to_device(arrays: Mapping[str, np.ndarray], mesh: Mesh | None = None) -> Batch:
    """Turn a loader's batch (this process's share of it) into a `Batch`, split over the mesh (None: on the default device)."""

    def put(x: np.ndarray) -> jax.Array:
        if mesh is None:
            return jax.numpy.asarray(x)
        return jax.make_array_from_process_local_data(split(mesh), x)

    def put_if_there(name: str) -> jax.Array | None:
        return put(arrays[name]) if name in arrays else None

    views = arrays.get("views")
    pose = RigidTransform(R=put(arrays["R"]), t=put(arrays["t"])) if "R" in arrays else None
    return Batch(
        source=put(arrays["source"]),
        target=put(arrays["target"]),
        views=None if views is None else put(views[..., None]),
        target_from_source=pose,
        source_normals=put_if_there("source_normals"),
        target_normals=put_if_there("target_normals"),
    )
