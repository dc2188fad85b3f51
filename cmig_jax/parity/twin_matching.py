"""The PyTorch twin's correspondence search and pose (Sec. III-E, Eq. 10, 11), as the released network has them.

Channels second: keypoints `[B, 3, K]`, features `[B, C, K]`, pairs of keypoints `[B, C, K_src, K_tgt]`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class ConvStack(nn.Module):
    """1x1 convolutions: `widths` with BatchNorm and ReLU (no bias), then one with bias and nothing after it."""

    def __init__(self, conv: type[nn.Conv1d] | type[nn.Conv2d], inputs: int, widths: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for width in widths:
            layers.append(ConvBlock(conv, inputs, width))
            inputs = width
        self.conv = nn.Sequential(*layers, conv(inputs, outputs, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Map `[B, inputs, ...]` to `[B, outputs, ...]`."""
        return self.conv(x)


class ConvBlock(nn.Module):
    """A 1x1 convolution without bias, BatchNorm and ReLU."""

    def __init__(self, conv: type[nn.Conv1d] | type[nn.Conv2d], inputs: int, width: int) -> None:
        super().__init__()
        self.conv = conv(inputs, width, 1, bias=False)
        self.bn = (nn.BatchNorm1d if conv is nn.Conv1d else nn.BatchNorm2d)(width)

    def forward(self, x: Tensor) -> Tensor:
        """Map `[B, inputs, ...]` to `[B, width, ...]`."""
        return torch.relu(self.bn(self.conv(x)))


class PoseHead(nn.Module):
    """`head`: weighted SVD about unweighted centroids. `reflect` is part of the released state and is never used."""

    def __init__(self) -> None:
        super().__init__()
        self.reflect = nn.Parameter(torch.diag(torch.tensor([1.0, 1.0, -1.0])), requires_grad=False)

    def forward(self, src: Tensor, corresponding: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """Return R `[B, 3, 3]`, t `[B, 3]` that take `src` `[B, 3, K]` to `corresponding`, with weights `[B, K]` that sum to 1."""
        x = src - src.mean(-1, keepdim=True)
        y = corresponding - corresponding.mean(-1, keepdim=True)
        U, _, Vh = torch.linalg.svd((x * weight.unsqueeze(1)) @ y.transpose(1, 2))
        V = Vh.transpose(1, 2)
        reflected = torch.det(V @ U.transpose(1, 2)) < 0
        V = torch.cat((V[..., :2], torch.where(reflected[:, None, None], -V[..., 2:], V[..., 2:])), dim=-1)
        R = V @ U.transpose(1, 2)
        center_x, center_y = (src * weight.unsqueeze(1)).sum(-1), (corresponding * weight.unsqueeze(1)).sum(-1)
        return R, center_y - (R @ center_x.unsqueeze(-1)).squeeze(-1)


def feature_pairs(src: Tensor, tgt: Tensor) -> Tensor:
    """Return `[B, 1 + C, K, K]`: distance and direction from source to target features `[B, C, K]`."""
    diff = tgt.unsqueeze(2) - src.unsqueeze(3)
    dist = diff.norm(dim=1, keepdim=True)
    return torch.cat((dist, diff / (dist + 1e-8)), dim=1)


def coordinate_pairs(src: Tensor, tgt: Tensor) -> Tensor:
    """Return `[B, 7, K, K]`: distance and direction from target to source keypoints `[B, 3, K]`, and the source keypoint."""
    diff = src.unsqueeze(3) - tgt.unsqueeze(2)
    dist = diff.norm(dim=1, keepdim=True)
    return torch.cat((dist, diff / (dist + 1e-8), src.unsqueeze(3).expand_as(diff)), dim=1)


def credibility(logit: Tensor) -> Tensor:
    """Return weights `[B, K]` that sum to 1: sigmoid of the logits, 0 below the lower median (Eq. 10)."""
    score = torch.sigmoid(logit)
    median = score.median(dim=-1, keepdim=True).values
    score = torch.where(score >= median, score, torch.zeros_like(score))
    return score / (score.sum(-1, keepdim=True) + 1e-8)
