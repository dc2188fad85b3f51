"""Image encoder: a ResNet per view, then the maximum over views (Eq. 1).

The network sees ImageNet-normalised RGB, as the reference does. A depth view is one channel shown as grey, so its stem needs
one input channel and a constant: the three normalised copies of a pixel x meet the kernel as `x sum_c(W_c / std_c)` minus the
response to the constant image `mean_c / std_c`, which is computed once. The same numbers, a third of the stem's work.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.nn.recompute import call
from cmig_jax.ops.convolution import convolve
from cmig_jax.ops.pooling import max_pool

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
he_fan_out = nn.initializers.variance_scaling(2.0, "fan_out", "normal")


class ViewEncoder(nn.Module):
    """ResNet with basic blocks; (64, 128, 256, 512) channels and (2, 2, 2, 2) blocks are ResNet-18."""

    widths: tuple[int, ...] = (64, 128, 256, 512)
    blocks: tuple[int, ...] = (2, 2, 2, 2)
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, views: Array, *, train: bool) -> Array:
        """Encode views `[..., H, W, 1]` (uint8 depth) or `[..., H, W, 3]` (normalised RGB) to `[..., widths[-1]]`."""
        x = Stem(self.widths[0], compute=self.compute, name="stem")(views.reshape(-1, *views.shape[-3:]))
        # The ReLU after the maximum: the same numbers, a quarter of them.
        x = BatchNorm(self.widths[0], self.compute, name="stem_norm")(x, train=train)
        x = nn.relu(max_pool(x, self.compute.kernels))
        for stage, (width, count) in enumerate(zip(self.widths, self.blocks, strict=True)):
            for block in range(count):
                stride = 2 if stage > 0 and block == 0 else 1
                module = BasicBlock(width, stride, compute=self.compute, name=f"stage_{stage}_block_{block}")
                x = call(module, x, recompute=self.compute.recompute, train=train)
        pooled = jnp.mean(x.astype(jnp.promote_types(x.dtype, jnp.float32)), axis=(1, 2))
        return pooled.reshape(*views.shape[:-3], -1)


class Stem(nn.Module):
    """The 7x7 convolution of stride 2."""

    features: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, images: Array) -> Array:
        """Map `[B, H, W, 1]` uint8 depth or `[B, H, W, 3]` normalised RGB to `[B, H / 2, W / 2, features]`."""
        kernel = self.param("kernel", he_fan_out, (7, 7, 3, self.features))
        if images.shape[-1] == 3:
            return self._convolve(images, kernel)
        mean, std = (jnp.asarray(v, kernel.dtype)[None, None, :, None] for v in (IMAGENET_MEAN, IMAGENET_STD))
        grey = jnp.sum(kernel / std, axis=2, keepdims=True)
        constant = -jnp.sum(kernel * mean / std, axis=2, keepdims=True)
        response = self._convolve(jnp.ones((1, *images.shape[1:]), kernel.dtype), constant)
        # As a product, so that its derivative is one too: on a CPU a sum over the first axis of a large array is many times slower.
        ones = jnp.ones((len(images), 1), response.dtype)
        repeated = jnp.matmul(ones, response.reshape(1, -1), precision=jax.lax.Precision.HIGHEST).reshape(-1, *response.shape[1:])
        return self._convolve(images.astype(kernel.dtype) / 255, grey) + repeated

    def _convolve(self, x: Array, kernel: Array) -> Array:
        dtype = self.compute.dtype or kernel.dtype
        return convolve(x.astype(dtype), kernel.astype(dtype), 2, self.compute.kernels)


class Convolution(nn.Module):
    """A square convolution without bias, padded so that stride 1 keeps the size."""

    features: int
    size: int
    stride: int = 1
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """Map `[B, H, W, C]` to `[B, ceil(H / stride), ceil(W / stride), features]`."""
        kernel = self.param("kernel", he_fan_out, (self.size, self.size, x.shape[-1], self.features))
        dtype = self.compute.dtype or kernel.dtype
        return convolve(x.astype(dtype), kernel.astype(dtype), self.stride, self.compute.kernels)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions beside a shortcut (He et al., CVPR 2016)."""

    features: int
    stride: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, x: Array, *, train: bool) -> Array:
        """Map `[B, H, W, C]` to `[B, H / stride, W / stride, features]`."""
        shortcut = x
        if self.stride != 1 or x.shape[-1] != self.features:
            shortcut = Convolution(self.features, 1, self.stride, self.compute, name="shortcut")(x)
            shortcut = BatchNorm(self.features, self.compute, name="shortcut_norm")(shortcut, train=train)
        y = Convolution(self.features, 3, self.stride, self.compute, name="conv_0")(x)
        y = nn.relu(BatchNorm(self.features, self.compute, name="norm_0")(y, train=train))
        y = Convolution(self.features, 3, compute=self.compute, name="conv_1")(y)
        return nn.relu(BatchNorm(self.features, self.compute, name="norm_1")(y, train=train) + shortcut)
