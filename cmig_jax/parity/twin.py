"""The released CMIGNet in plain PyTorch: the yardstick that the Flax network is measured with.

Parameter names and shapes are those of the released network's `state_dict`, unused parameters included; layout is channels second:
points `[B, 3, N]`, views `[B, V, 3, H, W]`, R `[B, 3, 3]`, t `[B, 3]`. Written the obvious way, not the fast way. Sec. III of the paper.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from cmig_jax.parity import twin_losses
from cmig_jax.parity.sizes import CREDIBILITY_WIDTH, Sizes
from cmig_jax.parity.twin_attention import Transformer
from cmig_jax.parity.twin_encoders import ImageEncoder, PointEncoder
from cmig_jax.parity.twin_matching import ConvStack, PoseHead, coordinate_pairs, credibility, feature_pairs


class Twin(nn.Module):
    """The released network.

    Args:
        sizes: widths and counts.
        margins: positive and negative margin of the overlap loss; None turns it off, as the released scripts do.
    """

    def __init__(self, sizes: Sizes | None = None, margins: tuple[float, float] | None = None) -> None:
        super().__init__()
        self.sizes = s = sizes or Sizes()
        self.margins = margins
        n, conv1, conv2 = range(s.iterations), nn.Conv1d, nn.Conv2d
        self.emb_nn = PointEncoder(s.k, s.widths, s.dim)
        self.significance_fc = ConvStack(conv1, s.dim, (s.dim // 2, s.dim // 4, s.dim // 8, s.dim // 16), 1)
        self.head = PoseHead()
        self.sim_mat_Fconv = nn.ModuleList([ConvStack(conv2, s.dim + 1, s.feature_widths, 1) for _ in n])
        self.sim_mat_Sconv = nn.ModuleList([ConvStack(conv2, 7, s.coordinate_widths, 1) for _ in n])
        self.weight_fc = nn.ModuleList([ConvStack(conv1, CREDIBILITY_WIDTH, (CREDIBILITY_WIDTH,), 1) for _ in n])
        self.preweight = nn.ModuleList([ConvStack(conv2, 2, (), CREDIBILITY_WIDTH) for _ in n])
        self.MVCNN = ImageEncoder(s.image_widths, s.image_blocks)
        self.attn = Transformer(s.dim, s.heads, s.feed_forward)
        self.h3 = _score_network(2 * s.dim, (s.dim, s.dim // 2, s.dim // 4))

    def forward(
        self,
        src: Tensor,
        tgt: Tensor,
        views: Tensor,
        R_gt: Tensor | None = None,
        t_gt: Tensor | None = None,
        src_idx: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> dict[str, Tensor]:
        """Run the network.

        Args:
            src, tgt: `[B, 3, N]` points; both clouds have N.
            views: `[B, V, 3, H, W]` normalised images.
            R_gt, t_gt: the true pose, needed in training mode.
            src_idx: `[B, K]` source keypoints to train on; drawn with `generator` where None.
            generator: source of the draw.

        Returns:
            Every intermediate result under its recorded name, and `layer_<i>` `[2B, C_i, N]`, the point encoder's layers (source
            clouds, then target clouds); `R`, `t`; in training mode also `src_idx`, `loss_terms` and `loss`.
        """
        out: dict[str, Tensor] = {}
        f_src, f_tgt = self._features(out, src, tgt, views)
        out["score_a"] = self._score(f_tgt, f_src)
        out["score_b"] = self._score(f_src, f_tgt)
        if self.training:
            if R_gt is None or t_gt is None:
                raise ValueError("the true pose R_gt, t_gt is needed in training mode")
            moved = R_gt @ src + t_gt.unsqueeze(-1)
            distance, nearest = twin_losses.pairwise(moved, tgt).min(dim=2)
            label = (distance < 0.05).to(src.dtype)
            out["src_idx"] = src_idx = self._draw(label, generator) if src_idx is None else src_idx.long()
            tgt_idx, label = nearest.gather(1, src_idx), label.gather(1, src_idx)
            terms = self._encoder_losses(out, moved, tgt)
        else:
            K = self.sizes.keypoints
            src_idx, tgt_idx, label, terms = out["score_a"].topk(K).indices, out["score_b"].topk(K).indices, None, []
        src, f_src, score_a = _take(src, src_idx), _take(f_src, src_idx), out["score_a"].gather(1, src_idx)
        tgt, f_tgt, score_b = _take(tgt, tgt_idx), _take(f_tgt, tgt_idx), out["score_b"].gather(1, tgt_idx)
        terms += self._iterate(out, src, tgt, f_src, f_tgt, score_a, score_b, label)
        if self.training:
            out["loss_terms"] = torch.stack(terms)
            out["loss"] = out["loss_terms"].sum()
        return out

    def _features(self, out: dict[str, Tensor], src: Tensor, tgt: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
        """Encode both modalities and fuse them: sections A and C."""
        features, layers = self.emb_nn(torch.cat((src, tgt)))
        out |= {f"layer_{i}": layer for i, layer in enumerate(layers)}
        f_src, f_tgt = out["feat_src"], out["feat_tgt"] = features.chunk(2)
        image = out["feat_views"] = self.MVCNN(views)
        a, b = out["attn_points_0"], out["attn_points_1"] = self.attn(f_src, f_tgt)
        f_src, f_tgt = f_src + a, f_tgt + b
        tokens = image.unsqueeze(-1).expand_as(f_src)
        a = out["attn_src_views_0"] = self.attn(f_src, tokens)[0]
        b = out["attn_tgt_views_0"] = self.attn(f_tgt, tokens)[0]
        return f_src + a, f_tgt + b

    def _score(self, points: Tensor, pooled: Tensor) -> Tensor:
        """Score by the features of the points `[B, C, N]` beside the maximum of the other cloud's: `[B, N]`."""
        beside = pooled.amax(-1, keepdim=True).expand_as(points)
        return torch.sigmoid(self.h3(torch.cat((points, beside), dim=1))).squeeze(1)

    def _draw(self, label: Tensor, generator: torch.Generator | None) -> Tensor:
        """Draw half of the keypoints mostly among the points with a true correspondent, half mostly among those without."""
        half = self.sizes.keypoints // 2
        matched = torch.multinomial(label + 1e-5, half, generator=generator)
        unmatched = torch.multinomial(1 - label + 1e-5, self.sizes.keypoints - half, generator=generator)
        return torch.cat((matched, unmatched), dim=1)

    def _encoder_losses(self, out: dict[str, Tensor], moved: Tensor, tgt: Tensor) -> list[Tensor]:
        f_src, f_tgt = out["feat_src"], out["feat_tgt"]
        cross_modal = twin_losses.cross_modal(f_src, f_tgt, out["feat_views"])
        if self.margins is None:
            return [cross_modal, torch.zeros_like(cross_modal)]
        return [cross_modal, twin_losses.overlap(f_src, f_tgt, moved, tgt, self.margins)]

    def _iterate(
        self,
        out: dict[str, Tensor],
        src: Tensor,
        tgt: Tensor,
        f_src: Tensor,
        f_tgt: Tensor,
        score_a: Tensor,
        score_b: Tensor,
        label: Tensor | None,
    ) -> list[Tensor]:
        """Search correspondences, solve for the pose, move, repeat; return the losses taken on the way (none without labels)."""
        terms = []
        R = torch.eye(3, dtype=src.dtype, device=src.device).expand(len(src), 3, 3)
        t = torch.zeros(len(src), 3, dtype=src.dtype, device=src.device)
        pairs = feature_pairs(f_src, f_tgt)
        for i in range(self.sizes.iterations):
            match_F = self.sim_mat_Fconv[i](pairs)
            match_S = self.sim_mat_Sconv[i](coordinate_pairs(src, tgt))
            logit = self.weight_fc[i](self.preweight[i](torch.cat((match_F, match_S), dim=1)).amax(-1)).squeeze(1)
            match = (match_F + match_S).squeeze(1).clamp(-20, 20)
            chosen = match.argmax(-1)
            weight, corresponding = credibility(logit), _take(tgt, chosen)
            with torch.no_grad():
                R_i, t_i = self.head(src, corresponding, weight)
            out |= {f"it{i}/match_F": match_F.squeeze(1), f"it{i}/match_S": match_S.squeeze(1), f"it{i}/logit": logit}
            out |= {f"it{i}/svd_src": src, f"it{i}/svd_corr": corresponding, f"it{i}/svd_w": weight, f"it{i}/R": R_i, f"it{i}/t": t_i}
            if label is not None:
                terms += [twin_losses.mask(score_a, score_b, match)] if i == 0 else []
                terms += [twin_losses.matching(match, label), twin_losses.credibility(logit, chosen)]
            src = R_i @ src + t_i.unsqueeze(-1)
            R, t = R_i @ R, (R_i @ t.unsqueeze(-1)).squeeze(-1) + t_i
        out |= {"R": R, "t": t}
        return terms


def _score_network(inputs: int, widths: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Conv1d(inputs, width, 1), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Conv1d(inputs, 1, 1))


def _take(x: Tensor, index: Tensor) -> Tensor:
    """Return columns `[B, C, K]` of `[B, C, N]`."""
    return x.gather(2, index.unsqueeze(1).expand(-1, x.shape[1], -1))
