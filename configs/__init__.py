"""The presets: every one a function that returns a `Config`. `python train.py --help` lists them."""

from __future__ import annotations

from collections.abc import Callable

from cmig_jax.config import Config
from configs.modelnet40 import corrected, corrected_cpu, modelnet40_cpu, paper, paper_cpu, released, released_cpu
from configs.quickstart import own_clouds, quickstart

PRESETS: dict[str, Callable[[], Config]] = {
    "quickstart": quickstart,
    "own-clouds": own_clouds,
    "paper": paper,
    "released": released,
    "corrected": corrected,
    "modelnet40-cpu": modelnet40_cpu,
    "paper-cpu": paper_cpu,
    "released-cpu": released_cpu,
    "corrected-cpu": corrected_cpu,
}
