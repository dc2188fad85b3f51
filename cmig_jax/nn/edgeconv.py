"""Point encoder: densely linked EdgeConv layers (Sec. III-A, "we employ channel connectivity").

An edge layer applies one matrix W to `[x_j - x_i, x_i]` for every neighbour j of i. With W = [A, B] that is
`A x_j + (B - A) x_i`: two products per point and one gather instead of k products, and the same numbers. BatchNorm and ReLU rise
(or, under a negative scale, fall) with their argument, so the maximum over neighbours is taken before them; the batch statistics
of the edges follow from those of the points.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.geometry.neighbors import knn, neighbour_maximum
from cmig_jax.nn.mlp import Dense, torch_kernel
from cmig_jax.nn.norm import Affine, BatchNorm, Moments, channels, moments

Clouds = tuple[Array, ...]


class PointEncoder(nn.Module):
    """EdgeConv layers, each on everything before it, and a last pointwise layer.

    The graph of a layer joins the k nearest points in the output of the layer before (in the coordinates, for the first).
    """

    k: int = 20
    widths: tuple[int, ...] = (64, 64, 64, 128)
    dim: int = 512
    rows: int = 0
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, clouds: Clouds, *, train: bool) -> Clouds:
        """Encode clouds, each `[B, N_c, 3]`, to `[B, N_c, dim]`; batch statistics are taken over all of them together."""
        collected, latest = [(cloud,) for cloud in clouds], clouds
        for i, width in enumerate(self.widths):
            neighbours = tuple(knn(x, self.k, self.rows) for x in latest)
            inputs = tuple(jnp.concatenate(parts, axis=-1) for parts in collected)
            latest = EdgeConv(width, dtype=self.dtype, name=f"edge_{i}")(inputs, neighbours, train=train)
            collected = [(*parts, x) for parts, x in zip(collected, latest, strict=True)]
        dense = Dense(self.dim, use_bias=False, dtype=self.dtype, name="last")
        outputs = tuple(dense(jnp.concatenate(parts, axis=-1)) for parts in collected)
        affine = BatchNorm(self.dim, name="last_norm").affine(moments(outputs) if train else None)
        return tuple(nn.relu(affine(x)).astype(cloud.dtype) for x, cloud in zip(outputs, clouds, strict=True))


class EdgeConv(nn.Module):
    """One edge layer with BatchNorm, ReLU and the maximum over neighbours (Wang et al., TOG 2019)."""

    features: int
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, clouds: Clouds, neighbours: Clouds, *, train: bool) -> Clouds:
        """Map clouds, each `[B, N_c, C]` with neighbours `[B, N_c, k]`, to `[B, N_c, features]`."""
        C = clouds[0].shape[-1]
        kernel = self.param("kernel", torch_kernel, (2 * C, self.features))
        norm = BatchNorm(self.features, name="norm")
        sign = jnp.where(norm.scale < 0, -1, 1).astype(kernel.dtype)  # a falling BatchNorm turns the maximum into a minimum
        projections = [self._project(x, kernel, sign) for x in clouds]
        neighbour, shift_neighbour = _centred([p for p, _ in projections])
        centre, shift_centre = _centred([q for _, q in projections])
        shift = shift_neighbour + shift_centre
        batch = _edge_moments(neighbour, centre, neighbours) if train else None
        affine = norm.affine(None if batch is None else dataclasses.replace(batch, mean=(batch.mean + shift) * sign))
        affine = Affine(mean=affine.mean * sign - shift, scale=affine.scale * sign, bias=affine.bias)
        outputs = []
        for p, q, index in zip(neighbour, centre, neighbours, strict=True):
            edge = neighbour_maximum(p, index) + q
            outputs.append(nn.relu(affine(edge)).astype(clouds[0].dtype))
        return tuple(outputs)

    def _project(self, x: Array, kernel: Array, sign: Array) -> tuple[Array, Array]:
        """Return `A x` and `(B - A) x`, signed, `[B, N, features]` each."""
        A, B = jnp.split(kernel * sign[None, :], 2)
        both = jnp.concatenate([A, B - A], axis=-1)
        if self.dtype is not None:
            x, both = x.astype(self.dtype), both.astype(self.dtype)
        p, q = jnp.split((x @ both).astype(kernel.dtype), 2, axis=-1)
        return p, q


def _centred(parts: list[Array]) -> tuple[list[Array], Array]:
    """Take a rough mean `[C]` off every part, so that squares keep their digits; return it too."""
    shift = jax.lax.stop_gradient(jnp.mean(jnp.stack([jnp.mean(x, axis=(0, 1)) for x in parts]), axis=0))
    return [x - channels(shift, 3) for x in parts], shift


def _edge_moments(neighbour: list[Array], centre: list[Array], neighbours: Clouds) -> Moments:
    """Statistics of `p_j + q_i` over all edges, from sums over points: of p by in-degree, of p_j q_i by the adjacency matrix."""
    k = neighbours[0].shape[-1]
    count = k * sum(p.shape[0] * p.shape[1] for p in neighbour)
    first, second = jnp.zeros_like(neighbour[0][0, 0]), jnp.zeros_like(neighbour[0][0, 0])
    for p, q, index in zip(neighbour, centre, neighbours, strict=True):
        adjacency = _adjacency(index, p.shape[1], p.dtype)
        degree = jnp.sum(adjacency, axis=1)[..., None]
        summed = jnp.einsum("bnm,bmc->bnc", adjacency, p)
        first += jnp.sum(degree * p + k * q, axis=(0, 1))
        second += jnp.sum(degree * p**2 + 2 * summed * q + k * q**2, axis=(0, 1))
    mean = first / count
    return Moments(mean=mean, variance=second / count - mean**2, count=count)


def _adjacency(index: Array, points: int, dtype: jnp.dtype) -> Array:
    """Return `[B, N, N]`, 1 where the column is a neighbour of the row, from neighbours `[B, N, k]`."""
    rows = jnp.arange(index.shape[1])[:, None]
    return jax.vmap(lambda i: jnp.zeros((index.shape[1], points), dtype).at[rows, i].set(1, unique_indices=True))(index)
