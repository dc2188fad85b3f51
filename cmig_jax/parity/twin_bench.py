"""The PyTorch twin of a benchmark's case: inference and the training step, whole and by stage, as plain callables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from cmig_jax.nn.resnet import IMAGENET_MEAN, IMAGENET_STD
from cmig_jax.parity.sizes import Sizes
from cmig_jax.parity.twin import Twin, _take
from cmig_jax.parity.twin_run import make_twin

Work = Callable[[], Any]


class GivenImages(nn.Module):
    """Stands where the image encoder does: the views are its result already."""

    def forward(self, views: Tensor) -> Tensor:
        """Return `[B, C]`."""
        return views


class TwinBench:
    """The twin in float32 on inputs in our layout.

    Args:
        sizes: of the network.
        state: weights under PyTorch names.
        source, target: `[B, N, 3]`.
        images: `[B, V, H, W]` uint8 depth, shown as normalised grey, or `[B, C]` to stand for the image encoder's result.
        R, t: the true pose.
        device: where to compute.
    """

    def __init__(
        self,
        sizes: Sizes,
        state: Mapping[str, NDArray],
        source: NDArray,
        target: NDArray,
        images: NDArray,
        R: NDArray,
        t: NDArray,
        device: Literal["cpu", "cuda"] = "cpu",
    ) -> None:
        self.device = torch.device(device)
        self.twin: Twin = make_twin(sizes, state, torch.float32).to(self.device)
        self.images = images.ndim == 4
        if not self.images:
            self.twin.MVCNN = GivenImages()  # pyright: ignore[reportAttributeAccessIssue]
        views = _normalised_grey(images) if self.images else images
        arrays = (source.swapaxes(1, 2), target.swapaxes(1, 2), views, R, t)
        self.inputs = tuple(torch.tensor(np.ascontiguousarray(x), dtype=torch.float32, device=self.device) for x in arrays)

    def inference(self) -> Work:
        """Return a call that finds the poses of the batch."""
        return lambda: self._evaluate()["R"]

    def training(self) -> Work:
        """Return a call that takes one step of Adam."""
        adam = torch.optim.Adam(self.twin.parameters(), lr=1e-4, weight_decay=1e-3)
        with self.device:
            generator = torch.Generator(self.device).manual_seed(0)

        def work() -> float:
            self.twin.train()
            adam.zero_grad(set_to_none=True)
            with self.device:
                loss = self.twin(*self.inputs, None, generator)["loss"]
                loss.backward()
            adam.step()
            return loss.item()

        return work

    def stages(self, train: bool) -> dict[str, Work]:
        """Return a call for each stage, fed what the stage before gives in evaluation; in training, forward and derivative."""
        twin, (src, tgt, views, *_) = self.twin, self.inputs
        out = {name: value.detach() for name, value in self._evaluate().items()}
        features, image = (out["feat_src"], out["feat_tgt"]), out["feat_views"]
        fused = (
            features[0] + out["attn_points_0"] + out["attn_src_views_0"],
            features[1] + out["attn_points_1"] + out["attn_tgt_views_0"],
        )
        K = twin.sizes.keypoints
        chosen = out["score_a"].topk(K).indices, out["score_b"].topk(K).indices
        scores = out["score_a"].gather(1, chosen[0]), out["score_b"].gather(1, chosen[1])
        points = _take(src, chosen[0]), _take(tgt, chosen[1])
        calls: dict[str, tuple[Callable[..., Any], tuple[Tensor, ...]]] = {
            "point_encoder": (lambda: twin.emb_nn(torch.cat((src, tgt)))[0], ()),
            "fusion": (self._fuse, (*features, image)),
            "scores": (lambda f, g: (twin._score(g, f), twin._score(f, g)), fused),
            "matching": (lambda f, g: self._match(*points, f, g, *scores), tuple(map(_take, fused, chosen))),
        }
        if self.images:
            calls["image_encoder"] = (lambda: twin.MVCNN(views), ())
        return {name: self._stage(call, inputs, train) for name, (call, inputs) in calls.items()}

    def peak_bytes(self) -> int:
        """Return the most memory that the device held."""
        return torch.cuda.max_memory_allocated(self.device)

    def _evaluate(self) -> dict[str, Tensor]:
        self.twin.eval()
        with torch.no_grad(), self.device:
            out = self.twin(*self.inputs[:3])
        self._wait()
        return out

    def _fuse(self, source: Tensor, target: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        a, b = self.twin.attn(source, target)
        source, target, tokens = source + a, target + b, image.unsqueeze(-1).expand_as(source)
        return source + self.twin.attn(source, tokens)[0], target + self.twin.attn(target, tokens)[0]

    def _match(self, src: Tensor, tgt: Tensor, f: Tensor, g: Tensor, score_a: Tensor, score_b: Tensor) -> tuple[Tensor, ...]:
        out: dict[str, Tensor] = {}
        self.twin._iterate(out, src, tgt, f, g, score_a, score_b, None)
        return tuple(value for name, value in out.items() if name.endswith(("match_F", "match_S", "logit")))

    def _stage(self, call: Callable[..., Any], inputs: tuple[Tensor, ...], train: bool) -> Work:
        inputs = tuple(x.clone().requires_grad_(train) for x in inputs)

        def work() -> Any:
            self.twin.train(train).zero_grad(set_to_none=True)
            with torch.set_grad_enabled(train), self.device:
                outputs = call(*inputs)
                outputs = outputs if isinstance(outputs, tuple) else (outputs,)
                if train:
                    torch.stack([x.sum() for x in outputs]).sum().backward()
            self._wait()
            return outputs

        return work

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def _normalised_grey(depth: NDArray) -> NDArray:
    """Show depth `[B, V, H, W]` as grey, normalised: `[B, V, 3, H, W]`."""
    mean, std = (np.array(v, np.float32)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD))
    return (depth[:, :, None].astype(np.float32) / 255 - mean) / std
