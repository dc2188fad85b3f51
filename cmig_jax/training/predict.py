"""Poses of many pairs from a trained network, in batches of one compiled shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from cmig_jax.compilation import finished
from cmig_jax.data.loader import stack
from cmig_jax.data.pairs import Pair
from cmig_jax.nn.cmignet import CMIGNet
from cmig_jax.structs import Batch, Prediction, RigidTransform
from cmig_jax.training.mesh import replicated, sharing, split, to_device

Poses = tuple[np.ndarray, np.ndarray]


class Predictor:
    """A network in evaluation mode.

    Args:
        model: the network.
        batch: pairs per call of the compiled function; short batches are filled up with copies of their last pair.
        mesh: the devices that share each batch; by default one.
    """

    def __init__(self, model: CMIGNet, batch: int, mesh: Mesh | None = None) -> None:
        self.batch = batch
        self._mesh = mesh

        def apply(variables: Mapping[str, Any], inputs: Batch) -> Prediction:
            prediction = model.apply(variables, inputs, train=False)
            assert isinstance(prediction, Prediction)
            return prediction

        def poses(variables: Mapping[str, Any], inputs: Batch) -> tuple[RigidTransform, RigidTransform | None]:
            with sharing(mesh):
                return apply(variables, inputs).target_from_source, inputs.target_from_source

        self.apply = jax.jit(apply)
        shardings: dict[str, Any] = {}
        if mesh is not None:
            shardings = {"in_shardings": (replicated(mesh), split(mesh)), "out_shardings": replicated(mesh)}
        self._poses = jax.jit(poses, **shardings)

    def __call__(self, variables: Mapping[str, Any], pairs: Sequence[Pair]) -> Poses:
        """Return R `[n, 3, 3]` and t `[n, 3]`, target_from_source, of pairs of equal shapes."""
        return _joined([found for found, _ in self._batches(variables, pairs)], len(pairs))

    def beside_truth(self, variables: Mapping[str, Any], pairs: Sequence[Pair]) -> tuple[Poses, Poses]:
        """Return the found poses, as a call does, and the true ones; of several processes each draws its share of the pairs only."""
        found, true = zip(*self._batches(variables, pairs), strict=True)
        return _joined(found, len(pairs)), _joined(true, len(pairs))

    def _batches(self, variables: Mapping[str, Any], pairs: Sequence[Pair]) -> list[tuple[Any, Any]]:
        """Predict batch by batch; this process makes its block of each, as the loader does in training."""
        process, processes = (0, 1) if self._mesh is None else (jax.process_index(), jax.process_count())
        share, results = self.batch // processes, []
        for start in range(0, len(pairs), self.batch):
            first = min(start + process * share, len(pairs) - 1)
            drawn = [pairs[i] for i in range(first, min(first + share, len(pairs)))]
            filled = drawn + [drawn[-1]] * (share - len(drawn))
            finished(results[-1:])  # one batch at a time on the devices, while the next one is drawn
            results.append(self._poses(variables, to_device(stack(filled), self._mesh)))
        return results


def _joined(poses: Sequence[RigidTransform], count: int) -> Poses:
    R, t = (np.concatenate([np.asarray(x) for x in parts])[:count] for parts in zip(*((p.R, p.t) for p in poses), strict=True))
    return R, t
