"""The transformer between two point sets (Sec. III-C), and attention from points to other tokens (Eq. 8).

A memory of equal tokens (an image vector repeated N times, Eq. 1) gives the same result as one token: attention over equal values
returns that value whatever the weights. Callers therefore pass one.
"""

from __future__ import annotations

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.mlp import MLP, Dense, activate
from cmig_jax.nn.norm import LayerNorm
from cmig_jax.ops.attention import attend


class PairTransformer(nn.Module):
    """One pre-norm encoder layer and one pre-norm decoder layer, each with a last norm; no dropout.

    Attributes:
        dim: channels.
        heads: of the attention.
        feed_forward: hidden channels of the feed-forward layers.
        negative_slope: of their activation; 0 is ReLU.
    """

    dim: int = 512
    heads: int = 4
    feed_forward: int = 1024
    compute: ComputeConfig = ComputeConfig()
    negative_slope: float = 0.0

    def setup(self) -> None:
        def attention() -> Attention:
            return Attention(self.dim, self.heads, self.compute)

        def feed_forward() -> FeedForward:
            return FeedForward(self.feed_forward, self.dim, self.compute, self.negative_slope)

        self.encoder_attention, self.encoder_feed_forward = attention(), feed_forward()
        self.encoder_norms = [LayerNorm() for _ in range(3)]
        self.decoder_attention, self.decoder_cross, self.decoder_feed_forward = attention(), attention(), feed_forward()
        self.decoder_norms = [LayerNorm() for _ in range(4)]

    def __call__(self, query: Array, memory: Array) -> Array:
        """Decode `query [B, N, C]` with `memory [B, M, C]` to `[B, N, C]`."""
        return self.decode(query, self.encode(memory))

    def encode(self, x: Array) -> Array:
        """Encode a set `[B, N, C]`."""
        norms = self.encoder_norms
        y = norms[0](x)
        x = x + self.encoder_attention(y, y)
        x = x + self.encoder_feed_forward(norms[1](x))
        return norms[2](x)

    def decode(self, x: Array, memory: Array) -> Array:
        """Decode a set `[B, N, C]` with an encoded one `[B, M, C]`."""
        norms = self.decoder_norms
        y = norms[0](x)
        x = x + self.decoder_attention(y, y)
        x = x + self.decoder_cross(norms[1](x), memory)
        x = x + self.decoder_feed_forward(norms[2](x))
        return norms[3](x)


class FeedForward(nn.Module):
    """Two linear layers with bias and a (leaky) ReLU between them."""

    hidden: int
    dim: int
    compute: ComputeConfig
    negative_slope: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Map `x [..., C]` to `[..., dim]`."""
        x = Dense(self.hidden, compute=self.compute, name="layer_0")(x)
        return Dense(self.dim, compute=self.compute, name="layer_1")(activate(x, self.negative_slope))


class Attention(nn.Module):
    """Multi-head scaled dot-product attention with four linear layers."""

    dim: int
    heads: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, query: Array, memory: Array) -> Array:
        """Attend from `query [B, N, C]` over `memory [B, M, C]`, to `[B, N, C]`."""

        def split(x: Array) -> Array:
            return x.reshape(*x.shape[:-1], self.heads, -1).swapaxes(-2, -3)

        q, k, v, out = (Dense(self.dim, compute=self.compute, name=name) for name in ("query", "key", "value", "out"))
        if memory.shape[-2] == 1 and not self.is_initializing():
            # The softmax of one number is 1: every query receives this token.
            return jnp.broadcast_to(out(v(memory)), query.shape).astype(query.dtype)
        attended = attend(split(q(query)), split(k(memory)), split(v(memory)), self.compute).swapaxes(-2, -3)
        return out(attended.reshape(*attended.shape[:-2], -1)).astype(query.dtype)


class CrossAttention(nn.Module):
    """Eq. 8: the points query the image tokens, `MLP(W V)`, W = softmax(Q K^T / sqrt(C_t)), and Q, K, V one MLP each.

    With one token (F_I, Eq. 1: N equal ones) W is 1 and every point receives the same vector; with one token per view it is
    attention.
    """

    dim: int = 512
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, points: Array, tokens: Array) -> Array:
        """Return what is added to `points [B, N, C]` given image tokens `[B, V, C]`: `[B, N, C]`."""

        def mlp(name: str) -> MLP:
            return MLP((self.dim, self.dim), self.compute, name=name)

        attended = attend(mlp("query")(points), mlp("key")(tokens), mlp("value")(tokens), self.compute)
        return mlp("out")(attended).astype(points.dtype)
