"""Geometry in jax.numpy, without parameters and without flax: distances, rotations, weighted Procrustes."""
