"""What the pairs of a point with its neighbours look like, whichever way the cloud is turned: a local feature beside the coordinates."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.point_pairs import point_pair_features
from cmig_jax.nn.mlp import NormedMLP
from cmig_jax.ops.edges import gather
from cmig_jax.ops.neighbours import knn
from cmig_jax.ops.pooling import maximum


class LocalPairs(nn.Module):
    """Shared layers on the point-pair features of each neighbour, and their maximum over the neighbours (after RPM-Net, Sec. 5.1).

    Angles with a normal count the same for either side of the surface: estimated normals of two clouds need not agree on the side.

    Attributes:
        k: neighbours, the point itself included.
        widths: channels of the layers, multiples of `groups`.
        groups: of the normalisation, whose statistics are those of the whole cloud.
    """

    k: int
    widths: tuple[int, ...]
    groups: int = 8
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, points: Array, normals: Array) -> Array:
        """Map `points [B, N, 3]` with unit `normals [B, N, 3]` to `[B, N, widths[-1]]`; no motion of the cloud changes it."""
        index = knn(points, self.k, self.compute)
        offset = gather(points, index) - points[:, :, None]
        own = jnp.broadcast_to(normals[:, :, None], offset.shape)
        angles, length = jnp.split(point_pair_features(offset, own, gather(normals, index)), [3], axis=-1)
        pair = jnp.concatenate([jnp.minimum(angles, jnp.pi - angles), length], axis=-1)
        layers = NormedMLP(self.widths, self.compute, use_bias=True, norm="group", groups=self.groups, name="layers")
        return maximum(layers(pair, train=False), 2, self.compute.kernels).astype(points.dtype)
