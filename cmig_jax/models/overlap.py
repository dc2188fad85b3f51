"""Which points of two clouds have a partner under the true pose: labels of overlap scores."""

from __future__ import annotations

import jax
from jax import Array

from cmig_jax.ops.neighbours import nearest
from cmig_jax.structs import Batch


def overlapping(batch: Batch, threshold: float, rows: int = 0) -> tuple[Array, Array]:
    """Return whether a point of the source, `[B, N]`, and of the target, `[B, M]`, has the other cloud closer than `threshold`.

    Args:
        batch: the pairs, with their true poses.
        threshold: a distance, object units.
        rows: rows of a distance matrix per chunk; 0: all at once.
    """
    assert batch.target_from_source is not None
    moved = batch.target_from_source.apply(batch.source)

    def near(points: Array, others: Array) -> Array:
        return jax.vmap(lambda x, y: nearest(x, y, rows)[1])(points, others) < threshold

    return near(moved, batch.target), near(batch.target, moved)
