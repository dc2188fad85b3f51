"""Poses of many pairs from a trained network, in batches of one compiled shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import flax.linen as nn
import jax
import numpy as np
from jax.sharding import Mesh

from cmig_jax.data.loader import stack
from cmig_jax.data.pairs import Pair
from cmig_jax.devices import replicated, sharing, split, to_device
from cmig_jax.models.base import predict
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform


class Predictor:
    """A network in evaluation mode.

    Args:
        module: the network.
        batch: pairs per call of the compiled function; short batches are filled with copies of their last pair.
        mesh: the devices that share each batch; by default the default device.
    """

    def __init__(self, module: nn.Module, batch: int, mesh: Mesh | None = None) -> None:
        self.batch = batch
        self._mesh = mesh

        def poses(variables: Mapping[str, Any], inputs: Batch) -> tuple[RigidTransform, RigidTransform | None]:
            with sharing(mesh):
                return predict(module, variables, inputs).target_from_source, inputs.target_from_source

        self.predict = jax.jit(lambda variables, inputs: predict(module, variables, inputs))
        shardings: dict[str, Any] = {}
        if mesh is not None:
            shardings = {"in_shardings": (replicated(mesh), split(mesh)), "out_shardings": replicated(mesh)}
        self._poses = jax.jit(poses, **shardings)

    def __call__(self, variables: Mapping[str, Any], pairs: Sequence[Pair]) -> RigidTransform:
        """Return target_from_source `[n]` of pairs of equal shapes, NumPy arrays."""
        return _joined([found for found, _ in self._batches(variables, pairs)], len(pairs)) if pairs else _no_poses()

    def beside_truth(self, variables: Mapping[str, Any], pairs: Sequence[Pair]) -> tuple[RigidTransform, RigidTransform]:
        """Return the estimated poses, as a call does, and the true ones; each of several processes makes only its share of the pairs."""
        estimated, true = zip(*self._batches(variables, pairs), strict=True)
        return _joined(estimated, len(pairs)), _joined(true, len(pairs))

    def _batches(self, variables: Mapping[str, Any], pairs: Sequence[Pair]) -> list[tuple[Any, Any]]:
        """Predict batch by batch; this process makes its block of each, as the loader does in training."""
        process, processes = (0, 1) if self._mesh is None else (jax.process_index(), jax.process_count())
        share, results = self.batch // processes, []
        for start in range(0, len(pairs), self.batch):
            first = min(start + process * share, len(pairs) - 1)
            drawn = [pairs[i] for i in range(first, min(first + share, len(pairs)))]
            filled = drawn + [drawn[-1]] * (share - len(drawn))
            jax.block_until_ready(results[-1:])  # one batch at a time on the devices, while the next one is made
            results.append(self._poses(variables, to_device(stack(filled), self._mesh)))
        return results


def _no_poses() -> RigidTransform:
    return RigidTransform(R=np.empty((0, 3, 3), np.float32), t=np.empty((0, 3), np.float32))


def _joined(poses: Sequence[Any], count: int) -> RigidTransform:
    R, t = (np.concatenate([np.asarray(x) for x in parts])[:count] for parts in zip(*((p.R, p.t) for p in poses), strict=True))
    return RigidTransform(R=R, t=t)
