"""Point encoder: densely linked EdgeConv layers (Sec. III-A, "we employ channel connectivity").

An edge layer applies one matrix W to `[x_j - x_i, x_i]` for every neighbour j of i. With W = [A, B] that is
`A x_j + (B - A) x_i`: two products per point and one gather instead of k products, and the same numbers. BatchNorm and ReLU increase
(or, for a negative scale, decrease) with their argument, so the maximum over neighbours is taken before them; the batch statistics
of the edges follow from those of the points.
"""

from __future__ import annotations

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.mlp import Dense, torch_kernel
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.ops.edges import edge_moments, neighbour_maximum
from cmig_jax.ops.moments import channels, moments
from cmig_jax.ops.neighbours import knn

Clouds = tuple[Array, ...]


class PointEncoder(nn.Module):
    """EdgeConv layers, each on the outputs of all layers before it, and a last pointwise layer.

    The graph of a layer joins the k nearest points in the output of the layer before (in the coordinates, for the first).
    """

    k: int = 20
    widths: tuple[int, ...] = (64, 64, 64, 128)
    dim: int = 512
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, clouds: Clouds, *, train: bool) -> Clouds:
        """Encode clouds, each `[B, N_c, 3]`, to `[B, N_c, dim]`; batch statistics are taken over all of them together."""
        collected, latest = [(cloud,) for cloud in clouds], clouds
        for i, width in enumerate(self.widths):
            neighbours = tuple(knn(x, self.k, self.compute) for x in latest)
            inputs = tuple(jnp.concatenate(parts, axis=-1) for parts in collected)
            latest = EdgeConv(width, self.compute, name=f"edge_{i}")(inputs, neighbours, train=train)
            collected = [(*parts, x) for parts, x in zip(collected, latest, strict=True)]
        dense = Dense(self.dim, use_bias=False, compute=self.compute, name="last")
        outputs = tuple(dense(jnp.concatenate(parts, axis=-1)) for parts in collected)
        batch = moments(outputs, self.compute.kernels) if train else None
        affine = BatchNorm(self.dim, self.compute, name="last_norm").affine(batch)
        return tuple(nn.relu(affine(x)).astype(cloud.dtype) for x, cloud in zip(outputs, clouds, strict=True))


class EdgeConv(nn.Module):
    """One edge layer with BatchNorm, ReLU and the maximum over neighbours (Wang et al., TOG 2019)."""

    features: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, clouds: Clouds, neighbours: Clouds, *, train: bool) -> Clouds:
        """Map clouds, each `[B, N_c, C]` with neighbours `[B, N_c, k]`, to `[B, N_c, features]`."""
        C = clouds[0].shape[-1]
        kernel = self.param("kernel", torch_kernel, (2 * C, self.features))
        norm = BatchNorm(self.features, self.compute, name="norm")
        sign = jnp.where(norm.scale < 0, -1, 1).astype(kernel.dtype)  # a negative scale turns the maximum into a minimum
        projections = [self._project(x, kernel, sign) for x in clouds]
        neighbour, shift_neighbour = _centred([p for p, _ in projections])
        centre, shift_centre = _centred([q for _, q in projections])
        shift = shift_neighbour + shift_centre
        batch = edge_moments(neighbour, centre, neighbours, self.compute) if train else None
        affine = norm.affine(None if batch is None else dataclasses.replace(batch, mean=(batch.mean + shift) * sign))
        affine = dataclasses.replace(affine, mean=affine.mean * sign - shift, scale=affine.scale * sign)
        outputs = []
        for p, q, index in zip(neighbour, centre, neighbours, strict=True):
            edge = neighbour_maximum(p, index, self.compute.kernels) + q
            outputs.append(nn.relu(affine(edge)).astype(clouds[0].dtype))
        return tuple(outputs)

    def _project(self, x: Array, kernel: Array, sign: Array) -> tuple[Array, Array]:
        """Return `A x` and `(B - A) x`, signed, `[B, N, features]` each."""
        A, B = jnp.split(kernel * sign[None, :], 2)
        both = jnp.concatenate([A, B - A], axis=-1)
        if self.compute.dtype is not None:
            x, both = x.astype(self.compute.dtype), both.astype(self.compute.dtype)
        p, q = jnp.split((x @ both).astype(kernel.dtype), 2, axis=-1)
        return p, q


def _centred(parts: list[Array]) -> tuple[Clouds, Array]:
    """Subtract a rough mean `[C]` from every part, so that squares keep their digits; return it too."""
    shift = jax.lax.stop_gradient(jnp.mean(jnp.stack([jnp.mean(x, axis=(0, 1)) for x in parts]), axis=0))
    return tuple(x - channels(shift, 3) for x in parts), shift
