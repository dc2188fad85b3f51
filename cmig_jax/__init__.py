"""CMIGNet in JAX and Flax."""
