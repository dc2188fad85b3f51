"""Presets, scales and experiments together, as the command line hands them in."""

from __future__ import annotations

from cmig_jax.experiments.schema import Catalogue

from . import PRESETS
from .experiments import EXPERIMENTS
from .scale import SCALES


def catalogue() -> Catalogue:
    """Return everything that `configs` defines."""
    return Catalogue(presets=PRESETS, scales=SCALES, experiments=EXPERIMENTS)
