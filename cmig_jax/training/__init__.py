"""Training: state and step, loop, optimiser, checkpoints, logs, several processes."""
