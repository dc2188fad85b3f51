"""The PyTorch twin of a benchmark's case: inference and the training step, whole and by stage, as plain callables."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.nn.resnet import IMAGENET_MEAN, IMAGENET_STD
from cmig_jax.parity.cases import State
from cmig_jax.parity.cmignet_twin import Tensors, Twin
from cmig_jax.parity.cmignet_twin_parts import take

Work = Callable[[], Any]


class TwinBench:
    """The twin in float32 on inputs in our layout.

    Args:
        flags: of the network, of the released kind.
        state: weights under PyTorch names.
        source, target: `[B, N, 3]`.
        images: `[B, V, H, W]` uint8 depth, shown as normalised grey, or `[B, C]` in place of the image encoder's result.
        R, t: the true pose.
        device: `cpu` or `cuda`.
    """

    def __init__(
        self, flags: CMIGNetFlags, state: State, source: NDArray, target: NDArray, images: NDArray, R: NDArray, t: NDArray, device: str
    ) -> None:
        self.device = torch.device(device)
        self.twin = Twin(flags, state, torch.float32, self.device)
        if images.ndim == 4:
            mean, std = (np.array(v, np.float32)[:, None, None] for v in (IMAGENET_MEAN, IMAGENET_STD))
            images = (images[:, :, None].astype(np.float32) / 255 - mean) / std
        arrays = {"src": source.swapaxes(1, 2), "tgt": target.swapaxes(1, 2), "views": images, "R_gt": R, "t_gt": t}
        self.inputs = {name: torch.tensor(np.ascontiguousarray(x), dtype=torch.float32, device=self.device) for name, x in arrays.items()}

    def inference(self) -> Work:
        """Return a call that finds the poses of the batch."""
        return lambda: self._evaluate()["R"]

    def training(self) -> Work:
        """Return a call that takes one step of Adam."""
        adam = torch.optim.Adam(self.twin.parameters.values(), lr=1e-4, weight_decay=1e-3)
        generator = torch.Generator(self.device).manual_seed(0)

        def work() -> float:
            adam.zero_grad(set_to_none=True)
            loss = self.twin(self.inputs, True, generator)["loss"]
            loss.backward()
            adam.step()
            return loss.item()

        return work

    def stages(self, train: bool) -> dict[str, Work]:
        """Return a call for each stage, fed what the stage before gives in evaluation; in training, forward and derivative."""
        twin, out, (src, tgt, views, *_) = self.twin, self._evaluate(), self.inputs.values()
        fused = tuple(out[f"feat_{c}"] + out[f"attn_points_{i}"] + out[f"attn_{c}_views_0"] for i, c in enumerate(("src", "tgt")))
        chosen = [out[name].topk(twin.flags.keypoints.count).indices for name in ("score_a", "score_b")]
        keypoints, features = tuple(map(take, (src, tgt), chosen)), tuple(map(take, fused, chosen))

        def match(*features: Tensor) -> tuple[Tensor, ...]:
            found: Tensors = {}
            twin.iterate(keypoints, features, (), None, found)
            return tuple(value for name, value in found.items() if name.endswith(("match_F", "match_S", "logit")))

        calls: dict[str, tuple[Callable[..., Any], tuple[Tensor, ...]]] = {
            "point_encoder": (lambda: twin.encode_points(src, tgt), ()),
            "fusion": (lambda f, g, image: twin.fuse(f, g, image, {}), (out["feat_src"], out["feat_tgt"], out["feat_views"])),
            "scores": (lambda f, g: (twin.score(g, f), twin.score(f, g)), fused),
            "matching": (match, features),
        }
        if views.ndim > 2:
            calls["image_encoder"] = (lambda: (twin.encode_views(views),), ())
        return {name: self._stage(call, inputs, train) for name, (call, inputs) in calls.items()}

    def peak_bytes(self) -> int:
        """Return the most memory that the device held."""
        return torch.cuda.max_memory_allocated(self.device)

    def _evaluate(self) -> Tensors:
        with torch.no_grad():
            out = self.twin(self.inputs, False)
        self._wait()
        return out

    def _stage(self, call: Callable[..., tuple[Tensor, ...]], inputs: tuple[Tensor, ...], train: bool) -> Work:
        inputs = tuple(x.clone().requires_grad_(train) for x in inputs)

        def work() -> tuple[Tensor, ...]:
            self.twin.training = train
            for parameter in self.twin.parameters.values():
                parameter.grad = None
            with torch.set_grad_enabled(train):
                outputs = call(*inputs)
                if train:
                    torch.stack([x.sum() for x in outputs]).sum().backward()
            self._wait()
            return outputs

        return work

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
