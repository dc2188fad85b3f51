"""Loading a trained network from a run folder, a weights file, or the package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax

from cmig_jax.config import Config
from cmig_jax.config_json import differences
from cmig_jax.data.pairs import Pair
from cmig_jax.inference.predictor import Predictor
from cmig_jax.inference.run_folder import load_variables, read_config
from cmig_jax.inference.weights_file import PRETRAINED, SUFFIX, check_variables, read_weights
from cmig_jax.models.base import initial_variables
from cmig_jax.models.networks import model_of
from cmig_jax.transform import RigidTransform


@dataclass(frozen=True)
class Network:
    """A trained network.

    Attributes:
        config: the flags it was trained with, or those given to `load`.
        variables: parameters and running statistics.
        predictor: its compiled evaluation.
        step: training steps behind it.
    """

    config: Config
    variables: dict[str, Any]
    predictor: Predictor
    step: int

    def __call__(self, pairs: Sequence[Pair]) -> RigidTransform:
        """Register prepared pairs (`data.pairs`, with views where the network reads them): target_from_source `[n]`, NumPy arrays."""
        return self.predictor(self.variables, pairs)

    @property
    def title(self) -> str:
        """Its name in tables and pictures."""
        return self.config.model.title


def load(
    source: str | Path | None = None, which: Literal["best", "last"] = "best", batch: int = 1, *, config: Config | None = None
) -> Network:
    """Load a trained network.

    Args:
        source: a run folder of `train.py`, a weights file (`cmig export`), or None for the network that comes with the package.
        which: checkpoint of a run folder: the best on validation (the last, if none was validated yet), or the last.
        batch: pairs per compiled call.
        config: flags to use instead of those of the training, such as other keypoints, precision or chunks; the weights must fit.

    Raises:
        ValueError: no run folder, no checkpoint in it, or one that does not fit its config; the message names the file. Or an invalid
            `batch` or `which`.
    """
    if batch < 1 or which not in ("best", "last"):
        raise ValueError(f"batch = {batch}, which = {which!r}: expected at least 1, and best or last")
    path = PRETRAINED if source is None else Path(source)
    trained, step, variables = read_weights(path) if path.suffix == SUFFIX else (read_config(path), None, None)
    config = config or trained
    model = model_of(config.model)
    module = model.build(config.model, config.compute)
    like = jax.eval_shape(lambda: initial_variables(module, config.model.needs, jax.random.key(0)))
    if variables is not None and step is not None:
        check_variables(variables, like, str(path))
    else:
        try:
            step, variables = load_variables(path, like, which)
        except ValueError as error:
            if changed := [flag for flag in differences(trained, config) if flag.startswith(("model.", "network"))]:
                raise ValueError(f"{error}; the weights were trained before {'; '.join(changed)}") from error
            raise
    return Network(config=config, variables=variables, predictor=Predictor(module, batch), step=step)


def trained_config(source: Path | None) -> Config:
    """Read the flags that a network was trained with, without its weights; None is the network that comes with the package.

    Raises:
        ValueError: as `load`.
    """
    path = PRETRAINED if source is None else source
    return read_weights(path)[0] if path.suffix == SUFFIX else read_config(path)
