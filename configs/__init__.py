"""The presets: every one a function that returns a `Config`. `python train.py --help` lists them."""

from __future__ import annotations

from collections.abc import Callable

from cmig_jax.config import Config
from configs.modelnet40 import corrected, modelnet40_cpu, paper, released
from configs.quickstart import quickstart

PRESETS: dict[str, Callable[[], Config]] = {
    "quickstart": quickstart,
    "paper": paper,
    "released": released,
    "corrected": corrected,
    "modelnet40-cpu": modelnet40_cpu,
}
