"""Poses of many pairs from a trained network, in batches of one compiled shape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np

from cmig_jax.data.loader import stack
from cmig_jax.data.pairs import Pair
from cmig_jax.nn.cmignet import CMIGNet
from cmig_jax.structs import Batch, Prediction
from cmig_jax.training.mesh import to_device


class Predictor:
    """A network in evaluation mode.

    Args:
        model: the network.
        batch: pairs per call of the compiled function; short batches are filled up with copies of their last pair.
    """

    def __init__(self, model: CMIGNet, batch: int) -> None:
        self.batch = batch

        def apply(variables: Mapping[str, Any], inputs: Batch) -> Prediction:
            prediction = model.apply(variables, inputs, train=False)
            assert isinstance(prediction, Prediction)
            return prediction

        self.apply = jax.jit(apply)
        self._pose = jax.jit(lambda variables, inputs: apply(variables, inputs).target_from_source)

    def __call__(self, variables: Mapping[str, Any], pairs: Sequence[Pair]) -> tuple[np.ndarray, np.ndarray]:
        """Return R `[n, 3, 3]` and t `[n, 3]`, target_from_source, of pairs of equal shapes."""
        R, t = [], []
        for start in range(0, len(pairs), self.batch):
            chunk = list(pairs[start : start + self.batch])
            filled = chunk + [chunk[-1]] * (self.batch - len(chunk))
            pose = self._pose(variables, to_device(stack(filled)))
            R.append(np.asarray(pose.R)[: len(chunk)])
            t.append(np.asarray(pose.t)[: len(chunk)])
        return np.concatenate(R), np.concatenate(t)
