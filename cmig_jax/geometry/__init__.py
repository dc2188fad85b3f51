"""Pure jax.numpy geometry: rotations, weighted Procrustes with its derivative, neighbours. No parameters, no flax."""
