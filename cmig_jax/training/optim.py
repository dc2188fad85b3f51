"""Adam and its schedule (Sec. IV-A), with PyTorch's meaning of weight decay."""

from __future__ import annotations

import optax

from cmig_jax.config import OptimConfig


def optimizer(config: OptimConfig, steps_per_epoch: int) -> optax.GradientTransformation:
    """Build the update rule: (clip,) add the decay to the gradient, Adam's moments, learning rate."""
    return optax.chain(
        optax.clip_by_global_norm(config.clip_norm) if config.clip_norm > 0 else optax.identity(),
        optax.add_decayed_weights(config.weight_decay),  # before the moments: L2, not AdamW
        optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-8),
        optax.scale_by_learning_rate(schedule(config, steps_per_epoch)),
    )


def schedule(config: OptimConfig, steps_per_epoch: int) -> optax.Schedule:
    """Return the learning rate as a function of the step."""
    if config.schedule == "step":
        return optax.piecewise_constant_schedule(
            config.learning_rate, {epoch * steps_per_epoch: config.decay for epoch in config.milestones}
        )
    total = config.epochs * steps_per_epoch
    return optax.warmup_cosine_decay_schedule(
        init_value=0.05 * config.learning_rate,
        peak_value=config.learning_rate,
        warmup_steps=max(1, total // 20),
        decay_steps=max(2, total),
        end_value=0.01 * config.learning_rate,
    )
