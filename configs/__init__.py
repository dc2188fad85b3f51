"""The presets by name: functions that return a `Config`. `cmig train --help` lists them.

Installed, this folder is the package `cmig_jax.presets`.
"""

from __future__ import annotations

from collections.abc import Callable

from cmig_jax.config import Config

from .methods import METHODS
from .modelnet40 import corrected, corrected_cpu, modelnet40_cpu, paper, paper_cpu, released, released_cpu
from .quickstart import own_clouds, own_clouds_cmignet, quickstart

PRESETS: dict[str, Callable[[], Config]] = {
    "quickstart": quickstart,
    "own-clouds": own_clouds,
    "own-clouds-cmignet": own_clouds_cmignet,
    "paper": paper,
    "released": released,
    "corrected": corrected,
    "modelnet40-cpu": modelnet40_cpu,
    "paper-cpu": paper_cpu,
    "released-cpu": released_cpu,
    "corrected-cpu": corrected_cpu,
    **METHODS,
}
