"""Gradient checkpointing: what a module computes is thrown away and computed again where the derivative needs it (Chen et al., 2016)."""

from __future__ import annotations

from typing import Any

import flax.linen as nn


def applied(module: nn.Module, *inputs: Any, recompute: bool, **flags: Any) -> Any:
    """Call a module; with `recompute`, its derivative keeps only `inputs` and computes the rest again. `flags` are no arrays."""

    def call(module: nn.Module, *inputs: Any) -> Any:
        return module(*inputs, **flags)

    return (nn.remat(call) if recompute else call)(module, *inputs)
