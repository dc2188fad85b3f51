"""Second fusion layer: what the images say, added to every point (Sec. III-C, Fig. 4, Eq. 8)."""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from cmig_jax.nn.attention import attend
from cmig_jax.nn.mlp import MLP


class CrossAttention(nn.Module):
    """Eq. 8: the points query the image tokens, `MLP(W V)`, W = softmax(Q K^T / sqrt(C_t)), and Q, K, V one MLP each.

    With one token (F_I, Eq. 1: N equal ones) W is 1 and every point receives the same vector; with one token per view it is
    attention.
    """

    dim: int = 512
    rows: int = 0
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, points: Array, tokens: Array) -> Array:
        """Return what is added to `points [B, N, C]` given image tokens `[B, V, C]`: `[B, N, C]`."""

        def mlp(name: str) -> MLP:
            return MLP((self.dim, self.dim), dtype=self.dtype, name=name)

        attended = attend(mlp("query")(points), mlp("key")(tokens), mlp("value")(tokens), self.rows)
        return mlp("out")(attended).astype(points.dtype)
