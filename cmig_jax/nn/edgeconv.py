"""Point encoders on neighbour graphs: EdgeConv layers on new graphs (CMIGNet, Sec. III-A; PRNet), and layers on the edges of one (DCP).

An edge layer applies one matrix W to `[x_j - x_i, x_i]` for every neighbour j of i. With W = [A, B] that is
`A x_j + (B - A) x_i`: two products per point and one gather instead of k products, and the same numbers. BatchNorm and ReLU increase
(or, for a negative scale, decrease) with their argument, so the maximum over neighbours is taken before them; the batch statistics
of the edges follow from those of the points.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.mlp import Dense, Weights, activate, torch_kernel
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.ops.chunks import chunk_length, join, split
from cmig_jax.ops.edges import edge_moments, gather, neighbour_maximum
from cmig_jax.ops.moments import Affine, channels, moments
from cmig_jax.ops.neighbours import knn
from cmig_jax.ops.pooling import maximum

Clouds = tuple[Array, ...]
POINTS_PER_CHUNK = 64  # of `StaticEdgeEncoder` in evaluation: the edges of a chunk stay in the cache


class PointEncoder(nn.Module):
    """EdgeConv layers, and a last pointwise layer on the outputs of all of them.

    The graph of a layer joins the k nearest points in the output of the layer before (in the coordinates, for the first).

    Attributes:
        k: neighbours, the point itself included.
        widths: channels of the EdgeConv layers.
        dim: channels of the last layer.
        linked: a layer reads the coordinates and the outputs of all layers before it (CMIGNet), or the output of the one before (PRNet).
        relative, negative_slope: as in `EdgeConv`.
    """

    k: int = 20
    widths: tuple[int, ...] = (64, 64, 64, 128)
    dim: int = 512
    compute: ComputeConfig = ComputeConfig()
    linked: bool = True
    relative: bool = True
    negative_slope: float = 0.0

    @nn.compact
    def __call__(self, clouds: Clouds, *, train: bool, local: Clouds = ()) -> Clouds:
        """Encode clouds, each `[B, N_c, 3]`, to `[B, N_c, dim]`; batch statistics are taken over all of them together.

        Args:
            clouds: coordinates.
            train: use batch statistics.
            local: `[B, N_c, F]` further features of the points, which linked layers read with the coordinates.
        """
        collected, latest = [(cloud,) if self.linked else () for cloud in clouds], clouds
        if local:
            collected = [(*parts, features) for parts, features in zip(collected, local, strict=True)]
        for i, width in enumerate(self.widths):
            neighbours = tuple(knn(x, self.k, self.compute) for x in latest)
            inputs = tuple(jnp.concatenate(parts, axis=-1) for parts in collected) if self.linked else latest
            layer = EdgeConv(width, self.compute, self.relative, self.negative_slope, name=f"edge_{i}")
            latest = layer(inputs, neighbours, train=train)
            collected = [(*parts, x) for parts, x in zip(collected, latest, strict=True)]
        dense = Dense(self.dim, use_bias=False, compute=self.compute, name="last")
        outputs = tuple(dense(jnp.concatenate(parts, axis=-1)) for parts in collected)
        batch = moments(outputs, self.compute.kernels) if train else None
        affine = BatchNorm(self.dim, self.compute, name="last_norm").affine(batch)
        return tuple(activate(affine(x), self.negative_slope).astype(cloud.dtype) for x, cloud in zip(outputs, clouds, strict=True))


class EdgeConv(nn.Module):
    """One edge layer with BatchNorm, (leaky) ReLU and the maximum over neighbours (Wang et al., TOG 2019).

    Attributes:
        features: output channels.
        relative: the input of an edge is `[x_j - x_i, x_i]`; otherwise `[x_j, x_i]`.
        negative_slope: of the activation, below 1; 0 is ReLU.
    """

    features: int
    compute: ComputeConfig = ComputeConfig()
    relative: bool = True
    negative_slope: float = 0.0

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
            outputs.append(activate(affine(edge), self.negative_slope).astype(clouds[0].dtype))
        return tuple(outputs)

    def _project(self, x: Array, kernel: Array, sign: Array) -> tuple[Array, Array]:
        """Return `A x` and `(B - A) x` (`B x` if not relative), signed, `[B, N, features]` each."""
        A, B = jnp.split(kernel * sign[None, :], 2)
        both = jnp.concatenate([A, B - A if self.relative else B], axis=-1)
        if self.compute.dtype is not None:
            x, both = x.astype(self.compute.dtype), both.astype(self.compute.dtype)
        p, q = jnp.split((x @ both).astype(kernel.dtype), 2, axis=-1)
        return p, q


class StaticEdgeEncoder(nn.Module):
    """Layers on the edges of one graph, the maximum of each over the neighbours, and a last pointwise layer on all of these (DCP).

    The graph joins the k nearest points. The input of an edge is `[x_j, x_i]`; every layer is linear, BatchNorm and ReLU.
    """

    k: int = 20
    widths: tuple[int, ...] = (64, 64, 128, 256)
    dim: int = 512
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        sizes = (6, *self.widths)
        self.edges = [Weights(inputs, width, use_bias=False) for inputs, width in zip(sizes, self.widths, strict=False)]
        self.norms = [BatchNorm(width, self.compute) for width in self.widths]
        self.last, self.last_norm = Dense(self.dim, use_bias=False, compute=self.compute), BatchNorm(self.dim, self.compute)

    def __call__(self, cloud: Array, *, train: bool) -> Array:
        """Encode a cloud `[B, N, 3]` to `[B, N, dim]`."""
        pooled = self.pooled(cloud, self.graph(cloud), train)
        return nn.relu(self.last_norm(self.last(jnp.concatenate(pooled, axis=-1)), train=train)).astype(cloud.dtype)

    def graph(self, cloud: Array) -> Array:
        """Return the neighbours `[B, N, k]` of each point, nearest first."""
        return knn(cloud, self.k, self.compute)

    def pooled(self, cloud: Array, neighbours: Array, train: bool) -> Clouds:
        """Return the maximum over the neighbours of each layer's output, `[B, N, width]` each."""
        (first, _), *rest = [weights() for weights in self.edges]
        A, B = jnp.split(first, 2)
        of_neighbour, of_centre = cloud @ A, cloud @ B
        kernels = [kernel for kernel, _ in rest]
        if train:

            def normalise(i: int, edges: Array) -> Affine:
                return self.norms[i].affine(moments([edges], self.compute.kernels))

            return self._layers(gather(of_neighbour, neighbours) + of_centre[:, :, None], kernels, normalise)
        affine = [norm.affine(None) for norm in self.norms]
        N, size = cloud.shape[1], chunk_length(cloud.shape[1], self.compute.rows or POINTS_PER_CHUNK)

        def chunk(parts: tuple[Array, Array]) -> Clouds:
            centre, index = parts
            return self._layers(gather(of_neighbour, index) + centre[:, :, None], kernels, lambda i, _: affine[i])

        chunks = jax.lax.map(chunk, (split(of_centre, 1, size), split(neighbours, 1, size)))
        return tuple(join(x, 1, N) for x in chunks)

    def _layers(self, edges: Array, kernels: list[Array], normalise: Callable[[int, Array], Affine]) -> Clouds:
        """Run the layers on the first one's products `[B, N, k, C]`."""
        outputs, dtype = [], self.compute.dtype or edges.dtype
        for i in range(len(kernels) + 1):
            if i:
                kernel = kernels[i - 1].astype(dtype)
                edges = (edges.astype(dtype).reshape(-1, len(kernel)) @ kernel).reshape(*edges.shape[:-1], -1)
            edges = nn.relu(normalise(i, edges)(edges))
            outputs.append(maximum(edges, 2, self.compute.kernels))
        return tuple(outputs)


def _centred(parts: list[Array]) -> tuple[Clouds, Array]:
    """Subtract a rough mean `[C]` from every part, so that squares keep their digits; return it too."""
    shift = jax.lax.stop_gradient(jnp.mean(jnp.stack([jnp.mean(x, axis=(0, 1)) for x in parts]), axis=0))
    return tuple(x - channels(shift, 3) for x in parts), shift
