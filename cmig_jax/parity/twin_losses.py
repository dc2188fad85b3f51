"""The PyTorch twin's losses (Sec. III-B, III-F) as the released network computes them, in its recorded order.

Channels second: features `[B, C, N]`, points `[B, 3, N]`, matching matrices `[B, K, K]`.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def cross_modal(src: Tensor, tgt: Tensor, image: Tensor, temperature: float = 0.1) -> Tensor:
    """Contrast the clouds' pooled features with the image vector `[B, C]`: NT-Xent over the 2B vectors."""
    pooled = (src.amax(-1) + tgt.amax(-1)) / 2
    vectors = F.normalize(torch.cat((pooled, image)), dim=-1)
    B = len(image)
    similarity = vectors @ vectors.T / temperature
    similarity = similarity.masked_fill(torch.eye(2 * B, dtype=torch.bool, device=image.device), -torch.inf)
    partner = torch.arange(2 * B, device=image.device).roll(B)
    return F.cross_entropy(similarity, partner)


def overlap(f: Tensor, g: Tensor, x: Tensor, y: Tensor, margins: tuple[float, float], threshold: float = 0.01) -> Tensor:
    """Pull overlapping points' features together, push overlapping from other points (Eq. 2).

    Args:
        f, g: `[B, C, N]` features of source and target.
        x: `[B, 3, N]` source points moved by the true pose.
        y: `[B, 3, N]` target points.
        margins: positive, negative.
        threshold: distance below which a point overlaps.
    """
    distance = pairwise(x, y)
    overlap_x, overlap_y = distance.amin(2) < threshold, distance.amin(1) < threshold
    per_pair = []
    for b in range(len(f)):
        in_x, out_x = f[b][:, overlap_x[b]], f[b][:, ~overlap_x[b]]
        in_y, out_y = g[b][:, overlap_y[b]], g[b][:, ~overlap_y[b]]
        pull = torch.relu(_feature_distance(in_x, in_y) - margins[0]) ** 2
        push_x = torch.relu(margins[1] - _feature_distance(in_x, out_y)) ** 2
        push_y = torch.relu(margins[1] - _feature_distance(in_y, out_x)) ** 2
        per_pair.append(sum(_active_mean(term) for term in (pull, push_x, push_y)))
    return torch.stack(per_pair).mean()


def mask(score_a: Tensor, score_b: Tensor, match: Tensor) -> Tensor:
    """Regress the keypoints' scores `[B, K]` on the negative entropy of their matching (Sec. III-F)."""
    with torch.no_grad():
        rows, columns = torch.log_softmax(match, 2), torch.log_softmax(match, 1)
        entropy_a, entropy_b = (rows.exp() * rows).sum(2), (columns.exp() * columns).sum(1)
    return ((score_a - entropy_a) ** 2).mean() / 2 + ((score_b - entropy_b) ** 2).mean() / 2


def matching(match: Tensor, label: Tensor) -> Tensor:
    """Return the mean negative log-likelihood of the diagonal, over the source keypoints whose label `[B, K]` is 1."""
    diagonal = torch.log_softmax(match, 2).diagonal(dim1=1, dim2=2)
    return -(diagonal * label).sum() / label.sum()


def credibility(logit: Tensor, chosen: Tensor) -> Tensor:
    """Cross entropy of the logits `[B, K]`; the target is 1 where the chosen target keypoint `[B, K]` has the same index."""
    target = (chosen == torch.arange(chosen.shape[1], device=chosen.device)).to(logit.dtype)
    return F.binary_cross_entropy_with_logits(logit, target)


def pairwise(x: Tensor, y: Tensor) -> Tensor:
    """Return the distances `[B, N, M]` between points `[B, C, N]` and `[B, C, M]`."""
    return torch.cdist(x.transpose(1, 2), y.transpose(1, 2), compute_mode="donot_use_mm_for_euclid_dist")


def _feature_distance(f: Tensor, g: Tensor) -> Tensor:
    return torch.sqrt(pairwise(f.unsqueeze(0), g.unsqueeze(0))[0] ** 2 + 1e-7)


def _active_mean(terms: Tensor) -> Tensor:
    active = terms[terms > 0]
    return active.mean() if len(active) else terms.sum()
