"""The parts of the PyTorch twin without weights: graphs, pairs of keypoints, the pose solver, and the losses in their recorded order.

Channels second: points `[B, 3, N]`, features `[B, C, N]`, pairs of keypoints `[B, C, K_src, K_tgt]`. Sec. III-B, III-E, III-F of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor

from cmig_jax.models.cmignet.flags import LossFlags


def take(x: Tensor, index: Tensor) -> Tensor:
    """Return columns `[B, C, K]` of `[B, C, N]`."""
    return x.gather(2, index.unsqueeze(1).expand(-1, x.shape[1], -1))


def pairwise(x: Tensor, y: Tensor) -> Tensor:
    """Return the distances `[B, N, M]` between points `[B, C, N]` and `[B, C, M]`."""
    return torch.cdist(x.transpose(1, 2), y.transpose(1, 2), compute_mode="donot_use_mm_for_euclid_dist")


def edge_features(linked: Tensor, latest: Tensor, k: int) -> Tensor:
    """Return `[B, 2C, N, k]`, neighbour minus centre, then centre, of `[B, C, N]`; neighbours are the k nearest in `latest`."""
    with torch.no_grad():
        neighbors = pairwise(latest, latest).topk(k, dim=-1, largest=False).indices
    neighbor = take(linked, neighbors.flatten(1)).unflatten(2, neighbors.shape[1:])
    center = linked.unsqueeze(-1).expand_as(neighbor)
    return torch.cat((neighbor - center, center), dim=1)


def feature_pairs(src: Tensor, tgt: Tensor) -> Tensor:
    """Return `[B, 1 + C, K, K]`: distance and direction from source to target features `[B, C, K]`."""
    difference = tgt.unsqueeze(2) - src.unsqueeze(3)
    distance = difference.norm(dim=1, keepdim=True)
    return torch.cat((distance, difference / (distance + 1e-8)), dim=1)


def coordinate_pairs(src: Tensor, tgt: Tensor) -> Tensor:
    """Return `[B, 7, K, K]`: distance and direction from target to source keypoints `[B, 3, K]`, and the source keypoint."""
    pairs = feature_pairs(tgt, src).transpose(2, 3)
    return torch.cat((pairs, src.unsqueeze(3).expand(-1, -1, -1, tgt.shape[2])), dim=1)


def weights(logit: Tensor) -> Tensor:
    """Return weights `[B, K]` that sum to 1: sigmoid of the logits, 0 below the lower median (Eq. 10)."""
    score = torch.sigmoid(logit)
    score = torch.where(score >= score.median(dim=-1, keepdim=True).values, score, 0)
    return score / (score.sum(-1, keepdim=True) + 1e-8)


def solve(src: Tensor, corresponding: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return R `[B, 3, 3]`, t `[B, 3]` that take `src` to `corresponding`, with weights `[B, K]` about unweighted centroids (Eq. 11)."""
    x, y = (points - points.mean(-1, keepdim=True) for points in (src, corresponding))
    U, _, Vh = torch.linalg.svd((x * weight.unsqueeze(1)) @ y.transpose(1, 2))
    V = Vh.transpose(1, 2)
    sign = torch.where(torch.det(V @ U.transpose(1, 2)) < 0, -1, 1).to(V.dtype)
    R = torch.cat((V[..., :2], V[..., 2:] * sign[:, None, None]), dim=-1) @ U.transpose(1, 2)
    center_x, center_y = ((points * weight.unsqueeze(1)).sum(-1) for points in (src, corresponding))
    return R, center_y - (R @ center_x.unsqueeze(-1)).squeeze(-1)


def encoder_losses(out: Mapping[str, Tensor], moved: Tensor, tgt: Tensor, flags: LossFlags) -> list[Tensor]:
    """Return the cross-modal and the overlap loss, given source points moved by the true pose and target points."""
    f, g = out["feat_src"], out["feat_tgt"]
    contrast = cross_modal((f.amax(-1) + g.amax(-1)) / 2, out["feat_views"], flags.temperature)
    return [contrast, overlap(f, g, pairwise(moved, tgt), flags) if flags.overlap else torch.zeros_like(contrast)]


def cross_modal(points: Tensor, images: Tensor, temperature: float) -> Tensor:
    """Contrast cloud vectors with image vectors, `[B, C]` each: NT-Xent over the 2B vectors."""
    vectors = F.normalize(torch.cat((points, images)), dim=-1)
    similarity = (vectors @ vectors.T / temperature).fill_diagonal_(-torch.inf)
    return F.cross_entropy(similarity, torch.arange(len(vectors), device=images.device).roll(len(images)))


def overlap(f: Tensor, g: Tensor, distance: Tensor, flags: LossFlags) -> Tensor:
    """Pull the features of overlapping points together, push them from those of other points, given distances `[B, N, M]` (Eq. 2).

    Each mean is over the pairs of points with a non-zero term.
    """
    in_x, in_y = distance.amin(2) < flags.overlap_threshold, distance.amin(1) < flags.overlap_threshold
    apart = torch.sqrt(pairwise(f, g) ** 2 + 1e-7)
    pull, push = torch.relu(apart - flags.margins[0]) ** 2, torch.relu(flags.margins[1] - apart) ** 2
    total = torch.zeros_like(apart[:, 0, 0])
    for term, x, y in ((pull, in_x, in_y), (push, in_x, ~in_y), (push, ~in_x, in_y)):
        term = term * (x.unsqueeze(2) & y.unsqueeze(1))
        total = total + term.sum((1, 2)) / (term > 0).sum((1, 2)).clamp(min=1)
    return total.mean()


def mask(scores: tuple[Tensor, ...], match: Tensor) -> Tensor:
    """Regress the keypoints' scores `[B, K]` on the negative entropy of their matching: rows, then columns (Sec. III-F)."""
    logs = [torch.log_softmax(match.detach(), dim) for dim in (2, 1)]
    entropies = (logs[0].exp() * logs[0]).sum(2), (logs[1].exp() * logs[1]).sum(1)
    return ((scores[0] - entropies[0]) ** 2).mean() / 2 + ((scores[1] - entropies[1]) ** 2).mean() / 2


def matching(match: Tensor, label: Tensor) -> Tensor:
    """Return the mean negative log-likelihood of the diagonal, over the source keypoints whose label `[B, K]` is 1."""
    return -(torch.log_softmax(match, 2).diagonal(dim1=1, dim2=2) * label).sum() / label.sum()


def credibility(logit: Tensor, chosen: Tensor) -> Tensor:
    """Cross entropy of the logits `[B, K]`; the target is 1 where the chosen target keypoint `[B, K]` has the same index."""
    right = chosen == torch.arange(chosen.shape[1], device=chosen.device)
    return F.binary_cross_entropy_with_logits(logit, right.to(logit.dtype))
