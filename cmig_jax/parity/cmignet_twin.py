"""The released CMIGNet in PyTorch, written from its description: what the Flax network is compared with where no case is recorded.

A function of named tensors whose names and shapes are those of the released `state_dict` (`cmignet_layout`). Layout is channels second:
points `[B, 3, N]`, features `[B, C, N]`, views `[B, V, 3, H, W]`. Written the obvious way, not the fast way. Sec. III of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.parity import cmignet_twin_parts as parts
from cmig_jax.parity.cases import State
from cmig_jax.parity.cmignet_layout import layout
from cmig_jax.parity.weights import COUNTER, RUNNING, to_flax

Tensors = dict[str, Tensor]


class Twin:
    """The network and its state; running statistics change in training mode.

    Args:
        flags: of the released kind, any sizes.
        state: weights under PyTorch names.
        dtype: what to compute in.
        device: where.

    Raises:
        ValueError: the state is not that of these flags.
    """

    def __init__(self, flags: CMIGNetFlags, state: State, dtype: torch.dtype = torch.float64, device: torch.device | str = "cpu") -> None:
        to_flax(state, layout(flags))  # checks names and shapes
        fixed = (*RUNNING, COUNTER, "reflect")
        self.flags, self.training = flags, False
        self.state: Tensors = {name: torch.tensor(value, dtype=dtype, device=device) for name, value in state.items()}
        self.parameters: Tensors = {name: x.requires_grad_() for name, x in self.state.items() if not name.endswith(fixed)}

    def __call__(self, inputs: Mapping[str, Tensor], train: bool, generator: Generator | None = None) -> Tensors:
        """Run the network.

        Args:
            inputs: `src`, `tgt`, `views` (or `[B, C]` in their place, the result of the image encoder), and for training `R_gt`, `t_gt`
                and `src_idx` `[B, K]`, the source keypoints, which are drawn if absent.
            train: training mode.
            generator: source of the draw.

        Returns:
            Every intermediate result by its recorded name; `R`, `t`; in training mode also `src_idx`, `loss_terms` and `loss`.
        """
        self.training = train
        (src, tgt), out, label, terms = (inputs["src"], inputs["tgt"]), {}, None, []
        out["feat_src"], out["feat_tgt"] = self.encode_points(src, tgt)
        out["feat_views"] = self.encode_views(inputs["views"])
        f_src, f_tgt = self.fuse(out["feat_src"], out["feat_tgt"], out["feat_views"], out)
        out["score_a"], out["score_b"] = self.score(f_tgt, f_src), self.score(f_src, f_tgt)
        if train:
            moved = inputs["R_gt"] @ src + inputs["t_gt"].unsqueeze(-1)
            distance, nearest = parts.pairwise(moved, tgt).min(dim=2)
            label = (distance < self.flags.loss.match_threshold).to(src.dtype)
            src_idx = out["src_idx"] = inputs["src_idx"] if "src_idx" in inputs else self._draw(label, generator)
            tgt_idx, label = nearest.gather(1, src_idx), label.gather(1, src_idx)
            terms = parts.encoder_losses(out, moved, tgt, self.flags.loss)
        else:
            src_idx, tgt_idx = (out[name].topk(self.flags.keypoints.count).indices for name in ("score_a", "score_b"))
        scores = out["score_a"].gather(1, src_idx), out["score_b"].gather(1, tgt_idx)
        keypoints = parts.take(src, src_idx), parts.take(tgt, tgt_idx)
        terms += self.iterate(keypoints, (parts.take(f_src, src_idx), parts.take(f_tgt, tgt_idx)), scores, label, out)
        return out | ({"loss_terms": torch.stack(terms), "loss": torch.stack(terms).sum()} if train else {})

    def encode_points(self, src: Tensor, tgt: Tensor) -> tuple[Tensor, Tensor]:
        """Encode both clouds `[B, 3, N]` as one batch: edge layers over graphs rebuilt at each layer, each reading all layers before."""
        linked, last = [torch.cat((src, tgt))], len(self.flags.points.widths) + 1
        for i in range(1, last):
            edges = parts.edge_features(torch.cat(linked, dim=1), linked[-1], self.flags.points.k)
            linked.append(self._block(edges, f"emb_nn.conv{i}", f"emb_nn.bn{i}").amax(dim=-1))
        features = self._block(torch.cat(linked, dim=1).unsqueeze(-1), f"emb_nn.conv{last}", f"emb_nn.bn{last}").squeeze(-1)
        return features[: len(src)], features[len(src) :]

    def encode_views(self, views: Tensor) -> Tensor:
        """Encode views as one vector per pair `[B, C]`: a ResNet on each, the maximum over views."""
        if views.ndim == 2:
            return views
        x = F.max_pool2d(self._block(views.flatten(0, 1), "MVCNN.net.0", "MVCNN.net.1", stride=2), 3, 2, 1)
        for stage, count in enumerate(self.flags.image.blocks):
            for b in range(count):
                name, stride = f"MVCNN.net.{4 + stage}.{b}", 2 if stage > 0 and b == 0 else 1
                y = self._block(x, f"{name}.conv1", f"{name}.bn1", stride)
                y = self._norm(self._convolve(y, f"{name}.conv2"), f"{name}.bn2")
                if f"{name}.downsample.0.weight" in self.state:
                    x = self._norm(self._convolve(x, f"{name}.downsample.0", stride), f"{name}.downsample.1")
                x = torch.relu(x + y)
        return x.mean(dim=(2, 3)).unflatten(0, views.shape[:2]).amax(dim=1)

    def fuse(self, f_src: Tensor, f_tgt: Tensor, image: Tensor, out: Tensors) -> tuple[Tensor, Tensor]:
        """Fuse the clouds `[B, C, N]` with each other, then each with the image vector `[B, C]`, by one transformer."""
        a, b = out["attn_points_0"], out["attn_points_1"] = self._attend(f_src, f_tgt)
        f_src, f_tgt = f_src + a, f_tgt + b
        tokens = image.unsqueeze(-1).expand_as(f_src)
        a = out["attn_src_views_0"] = self._attend(f_src, tokens)[0]
        b = out["attn_tgt_views_0"] = self._attend(f_tgt, tokens)[0]
        return f_src + a, f_tgt + b

    def score(self, points: Tensor, pooled: Tensor) -> Tensor:
        """Score by the features of the points `[B, C, N]` beside the maximum of the other cloud's: `[B, N]`."""
        x = torch.cat((points, pooled.amax(-1, keepdim=True).expand_as(points)), dim=1)
        for i in (0, 2, 4):
            x = torch.relu(self._convolve(x, f"h3.{i}"))
        return torch.sigmoid(self._convolve(x, "h3.6")).squeeze(1)

    def iterate(
        self, points: tuple[Tensor, ...], features: tuple[Tensor, ...], scores: tuple[Tensor, ...], label: Tensor | None, out: Tensors
    ) -> list[Tensor]:
        """Match keypoints `[B, 3, K]`, solve for the pose, move, repeat; return the losses taken on the way (none without labels)."""
        (src, tgt), terms, f_pairs = points, [], parts.feature_pairs(*features)
        R, t = torch.eye(3, dtype=src.dtype, device=src.device).expand(len(src), 3, 3), torch.zeros_like(src[..., 0])
        for i in range(self.flags.matching.iterations):
            match_F = self._stack(f_pairs, f"sim_mat_Fconv.{i}")
            match_S = self._stack(parts.coordinate_pairs(src, tgt), f"sim_mat_Sconv.{i}")
            best = self._stack(torch.cat((match_F, match_S), dim=1), f"preweight.{i}").amax(-1)
            logit, match = self._stack(best, f"weight_fc.{i}").squeeze(1), (match_F + match_S).squeeze(1).clamp(-20, 20)
            chosen = match.argmax(-1)
            weight, corresponding = parts.weights(logit), parts.take(tgt, chosen)
            with torch.no_grad():
                R_i, t_i = parts.solve(src, corresponding, weight)
            found = {"match_F": match_F.squeeze(1), "match_S": match_S.squeeze(1), "logit": logit, "R": R_i, "t": t_i}
            found |= {"svd_src": src, "svd_corr": corresponding, "svd_w": weight}
            out |= {f"it{i}/{name}": value for name, value in found.items()}
            if label is not None:
                terms += [parts.mask(scores, match)] if i == 0 else []
                terms += [parts.matching(match, label), parts.credibility(logit, chosen)]
            src = R_i @ src + t_i.unsqueeze(-1)
            R, t = R_i @ R, (R_i @ t.unsqueeze(-1)).squeeze(-1) + t_i
        out |= {"R": R, "t": t}
        return terms

    def _draw(self, label: Tensor, generator: Generator | None) -> Tensor:
        """Draw half of the keypoints mostly among the points with a true correspondent, half mostly among those without."""
        K = self.flags.keypoints.count
        halves = ((label + 1e-5, K // 2), (1 - label + 1e-5, K - K // 2))
        return torch.cat([torch.multinomial(p, count, generator=generator) for p, count in halves], dim=1)

    def _convolve(self, x: Tensor, name: str, stride: int = 1) -> Tensor:
        weight = self.state[f"{name}.weight"]
        convolve: Any = F.conv2d if weight.ndim == 4 else F.conv1d
        return convolve(x, weight, self.state.get(f"{name}.bias"), stride, weight.shape[-1] // 2)

    def _norm(self, x: Tensor, name: str) -> Tensor:
        mean, variance, scale, bias = (self.state[f"{name}.{leaf}"] for leaf in (*RUNNING, "weight", "bias"))
        return F.batch_norm(x, mean, variance, scale, bias, self.training, momentum=0.1, eps=1e-5)

    def _block(self, x: Tensor, layer: str, norm: str, stride: int = 1) -> Tensor:
        return torch.relu(self._norm(self._convolve(x, layer, stride), norm))

    def _stack(self, x: Tensor, name: str) -> Tensor:
        i = 0
        while f"{name}.conv.{i}.bn.weight" in self.state:
            x, i = self._block(x, f"{name}.conv.{i}.conv", f"{name}.conv.{i}.bn"), i + 1
        return self._convolve(x, f"{name}.conv.{i}")

    def _attend(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """Return a decoded with the encoding of b, and b with that of a: `[B, C, N]`."""
        a, b = a.transpose(1, 2), b.transpose(1, 2)
        a, b = self._layers("decoder", a, self._layers("encoder", b)), self._layers("decoder", b, self._layers("encoder", a))
        return a.transpose(1, 2), b.transpose(1, 2)

    def _layers(self, half: str, x: Tensor, memory: Tensor | None = None) -> Tensor:
        """Apply the one pre-norm layer of the encoder or the decoder, and its last norm, to tokens `[B, N, C]`."""
        name, i = f"attn.model.{half}.layers.0", 1
        y = self._layer_norm(x, f"{name}.sublayer.0.norm")
        x = x + self._attention(y, y, f"{name}.self_attn")
        if memory is not None:  # which is not normalised again
            x, i = x + self._attention(self._layer_norm(x, f"{name}.sublayer.1.norm"), memory, f"{name}.src_attn"), 2
        hidden = torch.relu(self._linear(self._layer_norm(x, f"{name}.sublayer.{i}.norm"), f"{name}.feed_forward.w_1"))
        return self._layer_norm(x + self._linear(hidden, f"{name}.feed_forward.w_2"), f"attn.model.{half}.norm")

    def _attention(self, queries: Tensor, memory: Tensor, name: str) -> Tensor:
        each = [self._linear(x, f"{name}.linears.{i}") for i, x in enumerate((queries, memory, memory))]
        q, k, v = (x.unflatten(-1, (self.flags.fusion.heads, -1)).transpose(1, 2) for x in each)
        weights = torch.softmax(q @ k.transpose(-1, -2) / q.shape[-1] ** 0.5, dim=-1)
        return self._linear((weights @ v).transpose(1, 2).flatten(2), f"{name}.linears.3")

    def _linear(self, x: Tensor, name: str) -> Tensor:
        return F.linear(x, self.state[f"{name}.weight"], self.state[f"{name}.bias"])

    def _layer_norm(self, x: Tensor, name: str) -> Tensor:
        """Normalise with the unbiased standard deviation and the epsilon outside the root."""
        mean, deviation = x.mean(-1, keepdim=True), x.std(-1, keepdim=True, unbiased=True)
        return self.state[f"{name}.a_2"] * (x - mean) / (deviation + 1e-6) + self.state[f"{name}.b_2"]
