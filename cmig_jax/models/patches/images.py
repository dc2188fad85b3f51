"""What depth views say of the patches of a cloud: the features of the pixels that their centres fall on, or one feature per view."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.data.render import EXTENT, camera_frames
from cmig_jax.geometry.distances import length
from cmig_jax.nn.mlp import Dense
from cmig_jax.nn.resnet import Convolution
from cmig_jax.ops.edges import gather

VIEWS = 6
LAYOUT = "axes"
HIDDEN = 0.1  # a point this far behind what a view shows at its pixel is hidden, in units of the cloud's radius
HIGHEST = jax.lax.Precision.HIGHEST


class FeatureMaps(nn.Module):
    """Three 3x3 convolutions, the second of stride 2."""

    widths: tuple[int, int, int] = (16, 32, 32)
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, views: Array) -> Array:
        """Map depth views `[B, V, H, W, 1]` uint8 to `[B, V, ceil(H / 2), ceil(W / 2), C]`.

        Raises:
            ValueError: views that are not the six along the axes, by their number.
        """
        if views.ndim != 5 or views.shape[1] != VIEWS or views.shape[-1] != 1:
            raise ValueError(
                f"views of a cloud {views.shape}: expected [B, {VIEWS}, H, W, 1], of views.layout = {LAYOUT} and views.of = both"
            )
        x = views.reshape(-1, *views.shape[2:]).astype(jnp.float32) / 255
        for i, (width, stride) in enumerate(zip(self.widths, (1, 2, 1), strict=True)):
            x = nn.relu(Convolution(width, 3, stride, self.compute, name=f"layer_{i}")(x))
        return x.reshape(*views.shape[:2], *x.shape[1:])


class PixelFeatures(nn.Module):
    """For each patch the mean, over the views that show its centre, of the features where it falls."""

    dim: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, views: Array, points: Array, index: Array) -> Array:
        """Return `[B, K, dim]`.

        Args:
            views: `[B, V, H, W, 1]` uint8, of the cloud.
            points: `[B, N, 3]` of the cloud.
            index: `[B, K]` centres of the patches.
        """
        maps = FeatureMaps(compute=self.compute, name="maps")(views)
        row, column, depth = project(points, index, views.shape[2])
        grey = jnp.take_along_axis(views.reshape(*views.shape[:2], -1), row * views.shape[3] + column, axis=2).astype(depth.dtype)
        shown = (grey > 0) & ((grey - 128) / 127 < depth + HIDDEN)
        flat = maps.reshape(*maps.shape[:2], -1, maps.shape[-1])
        place = (row // 2) * maps.shape[3] + column // 2
        features = jnp.take_along_axis(flat, place[..., None], axis=2)
        weight = shown / jnp.maximum(jnp.sum(shown, axis=1, keepdims=True), 1).astype(depth.dtype)
        mean = jnp.einsum("bvk,bvkc->bkc", weight.astype(features.dtype), features)
        return Dense(self.dim, compute=self.compute, name="last")(mean).astype(points.dtype)


class ViewTokens(nn.Module):
    """One feature for each view, for all patches alike."""

    dim: int
    compute: ComputeConfig = ComputeConfig()

    @nn.compact
    def __call__(self, views: Array, points: Array, index: Array) -> Array:
        """Map `views [B, V, H, W, 1]` to `[B, V, dim]`."""
        del index
        mean = jnp.mean(FeatureMaps(compute=self.compute, name="maps")(views), axis=(2, 3))
        return Dense(self.dim, compute=self.compute, name="last")(mean).astype(points.dtype)


def project(points: Array, index: Array, size: int) -> tuple[Array, Array, Array]:
    """Return the rows, columns and depths `[B, V, K]` of chosen points in the views of their cloud, as `data.render` fits and makes them.

    Args:
        points: `[B, N, 3]`.
        index: `[B, K]`.
        size: height and width of a view, pixels.
    """
    centred = points - jnp.mean(points, axis=1, keepdims=True)
    radius = jnp.max(length(centred), axis=1)[:, None, None]
    chosen = gather(centred / jnp.where(radius > 0, radius, 1), index)
    frames = jnp.asarray(camera_frames(LAYOUT, VIEWS), points.dtype)
    right, up, depth = jnp.moveaxis(jnp.einsum("vij,bkj->bvki", frames, chosen, precision=HIGHEST), -1, 0)
    row, column = (jnp.clip((EXTENT + x) * size / (2 * EXTENT), 0, size - 1).astype(jnp.int32) for x in (-up, right))
    return row, column, depth
