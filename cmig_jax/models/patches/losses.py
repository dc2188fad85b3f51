"""Losses of the patch transformer. They read a prediction and the batch, never parameters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import optax
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import squared_distances
from cmig_jax.models.patches.flags import PatchFlags
from cmig_jax.models.patches.prediction import PatchPrediction
from cmig_jax.structs import Batch


def losses(prediction: PatchPrediction, batch: Batch, flags: PatchFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Compare the matches of a training pass with the true pose.

    Returns:
        `matching`: the negative log-likelihood of the nearest patch of the other cloud, over the patches that have one within `near`, in
        both directions; `overlap`: the binary cross entropy of having one; `offset`: the distance (of the coordinates, summed) of soft
        correspondents from where the centres belong, times its weight.
    """
    del compute
    assert batch.target_from_source is not None
    found = prediction.matches
    moved = batch.target_from_source.apply(found.source)
    square = jax.lax.stop_gradient(squared_distances(moved, found.target))
    has_partner = jnp.min(square, axis=2) < flags.near**2, jnp.min(square, axis=1) < flags.near**2
    rows = optax.softmax_cross_entropy_with_integer_labels(found.match, jnp.argmin(square, axis=2))
    columns = optax.softmax_cross_entropy_with_integer_labels(jnp.swapaxes(found.match, 1, 2), jnp.argmin(square, axis=1))
    logits = found.source_logit, found.target_logit
    entropies = [
        jnp.mean(optax.sigmoid_binary_cross_entropy(x, label.astype(x.dtype))) for x, label in zip(logits, has_partner, strict=True)
    ]
    offset = jnp.sum(jnp.abs(found.corresponding - moved), axis=-1)
    return {
        "matching": _mean(rows, has_partner[0]) + _mean(columns, has_partner[1]),
        "overlap": entropies[0] + entropies[1],
        "offset": flags.offset_weight * _mean(offset, has_partner[0]),
    }


def _mean(values: Array, chosen: Array) -> Array:
    """Return the mean over the chosen values; 0 where there are none."""
    return jnp.sum(jnp.where(chosen, values, 0)) / jnp.maximum(jnp.sum(chosen), 1)
