"""The PyTorch twin's encoders: the densely linked DGCNN and the multi-view ResNet (Sec. III-A, Eq. 1).

Channels second: points `[B, 3, N]`, features `[B, C, N]`, views `[B, V, 3, H, W]`. Parameter names are those of the released network.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class PointEncoder(nn.Module):
    """`emb_nn`: edge convolutions over graphs that are rebuilt at each layer, every layer reading all layers before it."""

    def __init__(self, k: int, widths: tuple[int, ...], dim: int) -> None:
        super().__init__()
        self.k, self.layers = k, len(widths)
        linked = 3
        for i, width in enumerate(widths, start=1):
            self.add_module(f"conv{i}", nn.Conv2d(2 * linked, width, 1, bias=False))
            linked += width
        self.add_module(f"conv{self.layers + 1}", nn.Conv2d(linked, dim, 1, bias=False))
        for i, width in enumerate((*widths, dim), start=1):
            self.add_module(f"bn{i}", nn.BatchNorm2d(width))

    def forward(self, points: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Encode points `[B, 3, N]` as features `[B, dim, N]`; return also each layer's own output."""
        linked = [points]
        for i in range(1, self.layers + 1):
            edges = edge_features(torch.cat(linked, dim=1), nearest_neighbors(linked[-1], self.k))
            linked.append(self._block(i, edges).amax(dim=-1))
        features = self._block(self.layers + 1, torch.cat(linked, dim=1).unsqueeze(-1)).squeeze(-1)
        return features, linked[1:]

    def _block(self, i: int, x: Tensor) -> Tensor:
        return torch.relu(self.get_submodule(f"bn{i}")(self.get_submodule(f"conv{i}")(x)))


def nearest_neighbors(features: Tensor, k: int) -> Tensor:
    """Return `[B, N, k]`: for each point of `[B, C, N]` its k nearest points, itself included."""
    with torch.no_grad():
        points = features.transpose(1, 2)
        distance = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        return distance.topk(k, dim=-1, largest=False).indices


def edge_features(features: Tensor, neighbors: Tensor) -> Tensor:
    """Return `[B, 2C, N, k]`: neighbour minus centre, then centre."""
    B, C, N = features.shape
    flat = neighbors.reshape(B, 1, -1).expand(-1, C, -1)
    neighbor = features.gather(2, flat).reshape(B, C, N, -1)
    center = features.unsqueeze(-1).expand_as(neighbor)
    return torch.cat((neighbor - center, center), dim=1)


class ImageEncoder(nn.Module):
    """`MVCNN`: a ResNet on each view, the maximum over views. `fc` is part of the released state and is never used."""

    def __init__(self, widths: tuple[int, ...], blocks: tuple[int, ...], classes: int = 40) -> None:
        super().__init__()
        stem = [nn.Conv2d(3, widths[0], 7, stride=2, padding=3, bias=False), nn.BatchNorm2d(widths[0]), nn.ReLU(), nn.MaxPool2d(3, 2, 1)]
        stages, inputs = [], widths[0]
        for stage, (width, count) in enumerate(zip(widths, blocks, strict=True)):
            first = BasicBlock(inputs, width, stride=1 if stage == 0 else 2)
            stages.append(nn.Sequential(first, *(BasicBlock(width, width, stride=1) for _ in range(count - 1))))
            inputs = width
        self.net = nn.Sequential(*stem, *stages, nn.AdaptiveAvgPool2d(1))
        self.fc = nn.Sequential(nn.Linear(widths[-1], classes))

    def forward(self, views: Tensor) -> Tensor:
        """Encode views `[B, V, 3, H, W]` as one vector per pair `[B, C]`."""
        each = self.net(views.flatten(0, 1)).flatten(1)
        return each.reshape(*views.shape[:2], -1).amax(dim=1)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut, projected where the shape changes."""

    def __init__(self, inputs: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        projected = stride != 1 or inputs != width
        self.downsample = nn.Sequential(nn.Conv2d(inputs, width, 1, stride, bias=False), nn.BatchNorm2d(width)) if projected else None

    def forward(self, x: Tensor) -> Tensor:
        """Map `[B, inputs, H, W]` to `[B, width, H/stride, W/stride]`."""
        shortcut = x if self.downsample is None else self.downsample(x)
        y = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(shortcut + self.bn2(self.conv2(y)))
