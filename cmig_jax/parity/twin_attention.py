"""The PyTorch twin's transformer `attn`: one pre-norm encoder layer and one decoder layer (Sec. III-C).

Used three times with the same weights. Channels second outside `[B, C, N]`, tokens `[B, N, C]` inside. No dropout.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Transformer(nn.Module):
    """`attn`: decode each cloud against the encoding of the other."""

    def __init__(self, dim: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.model = EncoderDecoder(dim, heads, feed_forward)

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Return (a seen beside b, b seen beside a): `[B, C, N]` each, from `[B, C, N]` and `[B, C, M]`."""
        a, b = a.transpose(1, 2), b.transpose(1, 2)
        return self.model(memory_of=b, queries=a).transpose(1, 2), self.model(memory_of=a, queries=b).transpose(1, 2)


class EncoderDecoder(nn.Module):
    """`attn.model`."""

    def __init__(self, dim: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.encoder = Encoder(dim, heads, feed_forward)
        self.decoder = Decoder(dim, heads, feed_forward)

    def forward(self, memory_of: Tensor, queries: Tensor) -> Tensor:
        """Decode `queries` `[B, N, C]` with the encoding of `memory_of` `[B, M, C]` as memory."""
        return self.decoder(queries, self.encoder(memory_of))


class Encoder(nn.Module):
    """One layer and a last norm."""

    def __init__(self, dim: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([EncoderLayer(dim, heads, feed_forward)])
        self.norm = Norm(dim)

    def forward(self, x: Tensor) -> Tensor:
        """Encode tokens `[B, N, C]`."""
        for layer in self.layers:
            x = layer(x)
        return self.norm(x)


class Decoder(nn.Module):
    """One layer and a last norm."""

    def __init__(self, dim: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([DecoderLayer(dim, heads, feed_forward)])
        self.norm = Norm(dim)

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """Decode tokens `[B, N, C]` with memory `[B, M, C]`."""
        for layer in self.layers:
            x = layer(x, memory)
        return self.norm(x)


class EncoderLayer(nn.Module):
    """Self-attention and a feed-forward network, each added to what it reads."""

    def __init__(self, dim: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.self_attn = Attention(dim, heads)
        self.feed_forward = FeedForward(dim, feed_forward)
        self.sublayer = nn.ModuleList([Sublayer(dim) for _ in range(2)])

    def forward(self, x: Tensor) -> Tensor:
        """Map `[B, N, C]` to `[B, N, C]`."""
        y = self.sublayer[0](x)
        x = x + self.self_attn(y, y)
        return x + self.feed_forward(self.sublayer[1](x))


class DecoderLayer(nn.Module):
    """Self-attention, attention to a memory that is not normalised again, and a feed-forward network."""

    def __init__(self, dim: int, heads: int, feed_forward: int) -> None:
        super().__init__()
        self.self_attn = Attention(dim, heads)
        self.src_attn = Attention(dim, heads)
        self.feed_forward = FeedForward(dim, feed_forward)
        self.sublayer = nn.ModuleList([Sublayer(dim) for _ in range(3)])

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """Map `[B, N, C]` and a memory `[B, M, C]` to `[B, N, C]`."""
        y = self.sublayer[0](x)
        x = x + self.self_attn(y, y)
        x = x + self.src_attn(self.sublayer[1](x), memory)
        return x + self.feed_forward(self.sublayer[2](x))


class Sublayer(nn.Module):
    """Holds the norm before a residual branch, under the released name."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.norm = Norm(dim)

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the last axis."""
        return self.norm(x)


class Norm(nn.Module):
    """Layer norm with the unbiased standard deviation and the epsilon outside the root."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.a_2 = nn.Parameter(torch.ones(dim))
        self.b_2 = nn.Parameter(torch.zeros(dim))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the last axis."""
        mean, std = x.mean(-1, keepdim=True), x.std(-1, keepdim=True, unbiased=True)
        return self.a_2 * (x - mean) / (std + 1e-6) + self.b_2


class Attention(nn.Module):
    """Multi-head attention; `linears` are query, key, value and output."""

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.linears = nn.ModuleList([nn.Linear(dim, dim) for _ in range(4)])

    def forward(self, queries: Tensor, memory: Tensor) -> Tensor:
        """Attend from `[B, N, C]` to `[B, M, C]`."""
        q, k, v = (self._split(linear(x)) for linear, x in zip(self.linears, (queries, memory, memory), strict=False))
        weights = torch.softmax(q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5, dim=-1)
        return self.linears[3]((weights @ v).transpose(1, 2).flatten(2))

    def _split(self, x: Tensor) -> Tensor:
        return x.unflatten(-1, (self.heads, -1)).transpose(1, 2)


class FeedForward(nn.Module):
    """Two layers with a ReLU between."""

    def __init__(self, dim: int, hidden: int) -> None:
        super().__init__()
        self.w_1 = nn.Linear(dim, hidden)
        self.w_2 = nn.Linear(hidden, dim)

    def forward(self, x: Tensor) -> Tensor:
        """Map `[B, N, C]` to `[B, N, C]`."""
        return self.w_2(torch.relu(self.w_1(x)))
