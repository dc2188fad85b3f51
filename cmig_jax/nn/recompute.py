"""Gradient checkpointing: what a module computes is discarded, and computed again for the derivative (Chen et al., 2016)."""

from __future__ import annotations

from typing import Any

import flax.linen as nn


def call(module: nn.Module, *inputs: Any, recompute: bool, **options: Any) -> Any:
    """Call a module; with `recompute`, its derivative keeps only `inputs` and computes the rest again. `options` are not arrays."""

    def run(module: nn.Module, *inputs: Any) -> Any:
        return module(*inputs, **options)

    return (nn.remat(run) if recompute else run)(module, *inputs)
