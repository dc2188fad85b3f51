"""The transformer of the first fusion layer (Sec. III-C), and of the released network's second.

One pre-norm encoder layer and one decoder layer. `PairTransformer(query, memory)` decodes the query points with the encoded
other set as memory. A memory of equal tokens (the image vector repeated N times, Eq. 1) gives the same result as one token:
attention over equal values returns that value whatever the weights, so callers pass one.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.geometry.neighbors import map_rows
from cmig_jax.nn.mlp import MLP, Dense
from cmig_jax.nn.norm import LayerNorm


class PairTransformer(nn.Module):
    """Encoder and decoder of one layer each, with a last norm each; no dropout."""

    dim: int = 512
    heads: int = 4
    feed_forward: int = 1024
    rows: int = 0
    dtype: jnp.dtype | None = None

    def setup(self) -> None:
        def attention() -> Attention:
            return Attention(self.dim, self.heads, rows=self.rows, dtype=self.dtype)

        def feed_forward() -> MLP:
            return MLP((self.feed_forward, self.dim), dtype=self.dtype)

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


class Attention(nn.Module):
    """Multi-head scaled dot-product attention with four linear layers."""

    dim: int
    heads: int
    rows: int = 0
    dtype: jnp.dtype | None = None

    @nn.compact
    def __call__(self, query: Array, memory: Array) -> Array:
        """Attend from `query [B, N, C]` over `memory [B, M, C]`, to `[B, N, C]`."""

        def split(x: Array) -> Array:
            return x.reshape(*x.shape[:-1], self.heads, -1).swapaxes(-2, -3)

        q, k, v, out = (Dense(self.dim, dtype=self.dtype, name=name) for name in ("query", "key", "value", "out"))
        if memory.shape[-2] == 1 and not self.is_initializing():
            # The softmax of one number is 1: every query receives this token, whatever it asks.
            return jnp.broadcast_to(out(v(memory)), query.shape).astype(query.dtype)
        attended = attend(split(q(query)), split(k(memory)), split(v(memory)), self.rows).swapaxes(-2, -3)
        return out(attended.reshape(*attended.shape[:-2], -1)).astype(query.dtype)


def attend(query: Array, key: Array, value: Array, rows: int = 0) -> Array:
    """Return `softmax(Q K^T / sqrt(C)) V` for `[..., N, C]`, `[..., M, C]`, `[..., M, C]`, in chunks of `rows` queries (0: at once)."""
    return map_rows(lambda q: _attend(q, key, value), query, rows)


@jax.custom_vjp
def _attend(query: Array, key: Array, value: Array) -> Array:
    return _attend_forward(query, key, value)[0]


def _attend_forward(query: Array, key: Array, value: Array) -> tuple[Array, tuple[Array, ...]]:
    scores = jnp.einsum("...nc,...mc->...nm", query, key).astype(jnp.promote_types(query.dtype, jnp.float32))
    weights = nn.softmax(scores / query.shape[-1] ** 0.5, axis=-1).astype(value.dtype)
    attended = jnp.einsum("...nm,...mc->...nc", weights, value)
    return attended, (query, key, value, weights, attended)


def _attend_backward(saved: tuple[Array, ...], gradient: Array) -> tuple[Array, Array, Array]:
    """Differentiate by hand: XLA's own derivative of batched attention takes thrice the time on a CPU."""
    query, key, value, weights, attended = saved
    wide = jnp.promote_types(query.dtype, jnp.float32)
    of_weights = jnp.einsum("...nc,...mc->...nm", gradient, value).astype(wide)
    mean = jnp.sum((gradient * attended).astype(wide), axis=-1, keepdims=True)
    of_scores = (weights.astype(wide) * (of_weights - mean) / query.shape[-1] ** 0.5).astype(query.dtype)
    return (
        jnp.einsum("...nm,...mc->...nc", of_scores, key),
        jnp.einsum("...nm,...nc->...mc", of_scores, query),
        jnp.einsum("...nm,...nc->...mc", weights, gradient),
    )


_attend.defvjp(_attend_forward, _attend_backward)
