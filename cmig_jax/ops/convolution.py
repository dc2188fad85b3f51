"""Convolutions of images.

XLA's CPU compiler takes up to ten times as long for the derivative in the kernel as for the convolution itself. The fast version
computes it as products of shifted images. A 3 x 3 kernel of stride 1 (most of a ResNet) goes by Winograd's algorithm, forward and
backward: two by two results at a time from 16 products instead of 36 (Lavin and Gray, CVPR 2016, F(2 x 2, 3 x 3)). Its transforms only
add and halve, so it rounds like the plain sum.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import PartitionSpec

from cmig_jax.config import Kernels
from cmig_jax.ops.chunks import chunk_length, join, split
from cmig_jax.ops.kernels import is_fast

NUMBERS_PER_CHUNK = 2**21  # of intermediate results in a loop over images: they stay in a CPU's cache

# Winograd's matrices: two results in a row from four pixels d and three weights g are A^T ((G g) * (B^T d)).
B_T = ((1, 0, -1, 0), (0, 1, 1, 0), (0, -1, 1, 0), (0, 1, 0, -1))
G = ((1, 0, 0), (0.5, 0.5, 0.5), (0.5, -0.5, 0.5), (0, 0, 1))
G_T = tuple(zip(*G, strict=True))
A_T = ((1, 1, 1, 0), (0, 1, -1, -1))
A = tuple(zip(*A_T, strict=True))
TURNED = (3, 1, 2, 0)  # rows of G times the kernel read backwards


def convolve(x: Array, kernel: Array, stride: int = 1, kernels: Kernels = "auto") -> Array:
    """Convolve images with a square kernel of odd size, zeros around them.

    Args:
        x: `[B, H, W, C]`.
        kernel: `[s, s, C, C']`, s odd.
        stride: 1 or 2.
        kernels: which version; half precision always takes the plain one.

    Returns:
        `[B, ceil(H / stride), ceil(W / stride), C']`.
    """
    if not is_fast(kernels) or jnp.finfo(x.dtype).bits < 32:
        return _plain(x, kernel, stride)
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty or mesh.size == 1 or len(x) % mesh.size:
        return _fast(x, kernel, stride)
    # Each device loops over its own images; XLA alone would gather the images that a loop visits.
    images, whole = PartitionSpec(mesh.axis_names), PartitionSpec()
    own = functools.partial(_fast, stride=stride)
    return jax.shard_map(own, mesh=mesh, in_specs=(images, whole), out_specs=images, check_vma=False)(x, kernel)


def _plain(x: Array, kernel: Array, stride: int) -> Array:
    pad = kernel.shape[0] // 2
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), ((pad, pad), (pad, pad)), dimension_numbers=("NHWC", "HWIO", "NHWC"))


def _is_winograd(kernel: Array, stride: int) -> bool:
    return kernel.shape[0] == 3 and stride == 1


@functools.partial(jax.custom_vjp, nondiff_argnames=("stride",))
def _fast(x: Array, kernel: Array, stride: int) -> Array:
    return _winograd(x, _apply(G, kernel)) if _is_winograd(kernel, stride) else _plain(x, kernel, stride)


def _fast_forward(x: Array, kernel: Array, stride: int) -> tuple[Array, tuple[Array, Array]]:
    return _fast(x, kernel, stride), (x, kernel)


def _fast_backward(stride: int, saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = saved
    if _is_winograd(kernel, stride):
        weights = _apply(G, jax.lax.optimization_barrier(kernel))  # computed again: they are larger than the kernel
        turned = [weights[4 * i + j].T for i in TURNED for j in TURNED]
        return _winograd(gradient, turned), _winograd_of_kernel(x, gradient)
    (of_x,) = jax.linear_transpose(lambda image: _plain(image, kernel, stride), x)(gradient)
    return of_x, _of_kernel(x, gradient, kernel.shape[0], stride)


_fast.defvjp(_fast_forward, _fast_backward)


def _of_kernel(x: Array, gradient: Array, size: int, stride: int) -> Array:
    """Differentiate in the kernel: for each of its places a product of the gradient with the shifted image."""
    _, height, width, features = gradient.shape

    def visit(x: Array, gradient: Array) -> Array:
        pad = size // 2
        padded = jnp.pad(x, ((0, 0), (pad, pad + stride), (pad, pad + stride), (0, 0)))
        places = [(i, j) for i in range(size) for j in range(size)]
        shifted = [padded[:, i : i + stride * height : stride, j : j + stride * width : stride][:, :height, :width] for i, j in places]
        flat = gradient.reshape(-1, features)
        if x.shape[-1] == 1:
            return jnp.stack([part.reshape(-1) for part in shifted]) @ flat
        return jnp.stack([jnp.einsum("pc,pd->cd", part.reshape(flat.shape[0], -1), flat) for part in shifted])

    numbers = height * width * max(size**2 if x.shape[-1] == 1 else x.shape[-1], features)
    return _sum_over_images(visit, numbers, x, gradient).reshape(size, size, x.shape[-1], features)


def _winograd(x: Array, weights: Sequence[Array]) -> Array:
    """Convolve with a kernel that `G` has transformed to 16 weights `[C, C']`.

    There are 16 products of arrays instead of one product of stacked arrays, which XLA would copy once more.
    """

    def visit(x: Array) -> Array:
        return _joined([tile @ weight for tile, weight in zip(_tiles(x), weights, strict=True)], x)

    chunk = _images_per_chunk(x, 4 * x.shape[1] * x.shape[2] * max(weights[0].shape))
    return visit(x) if chunk == len(x) else join(jax.lax.map(visit, split(x, 0, chunk)), 0, len(x))


def _winograd_of_kernel(x: Array, gradient: Array) -> Array:
    """Differentiate in the kernel: the transposes of Winograd's transforms around one product for each of the 16 places."""
    features = gradient.shape[-1]

    def visit(x: Array, gradient: Array) -> Array:
        padded = jnp.pad(gradient, ((0, 0), (0, gradient.shape[1] % 2), (0, gradient.shape[2] % 2), (0, 0)))
        parts = _apply(A, [[padded[:, i::2, j::2] for j in range(2)] for i in range(2)])
        pairs = zip(_tiles(x), parts, strict=True)
        return jnp.stack([jnp.einsum("pc,pd->cd", tile, part.reshape(-1, features)) for tile, part in pairs])

    numbers = 4 * x.shape[1] * x.shape[2] * max(x.shape[-1], features)
    total = _sum_over_images(visit, numbers, x, gradient).reshape(4, 4, -1, features)
    return jnp.stack(_apply(G_T, total)).reshape(3, 3, -1, features)


def _tiles(x: Array) -> list[Array]:
    """Transform every tile of 4 x 4 pixels, two pixels apart, of the padded images: 16 arrays `[tiles, C]`."""
    _, height, width, C = x.shape
    padded = jnp.pad(x, ((0, 0), (1, 1 + height % 2), (1, 1 + width % 2), (0, 0)))
    rows, columns = height + height % 2, width + width % 2
    pixels = [[padded[:, i : i + rows : 2, j : j + columns : 2] for j in range(4)] for i in range(4)]
    return [part.reshape(-1, C) for part in _apply(B_T, pixels)]


def _joined(products: Sequence[Array], images: Array) -> Array:
    """Transform 16 arrays `[tiles, C]` to two by two results per tile, in the layout of the `images` that the tiles come from."""
    _, height, width, _ = images.shape
    down, right, C = -(-height // 2), -(-width // 2), products[0].shape[-1]
    places = [x.reshape(-1, down, right, C) for x in products]
    results = _apply(A_T, [places[4 * i : 4 * i + 4] for i in range(4)])
    rows = [jnp.stack(results[2 * i : 2 * i + 2], axis=3) for i in range(2)]
    return jnp.stack(rows, axis=2).reshape(-1, 2 * down, 2 * right, C)[:, :height, :width]


def _apply(matrix: Sequence[Sequence[float]], parts: Any) -> list[Array]:
    """Multiply a square of arrays (nested lists, or the first two axes of an array) by a matrix on the left, its transpose on the right."""

    def combine(row: Sequence[float], arrays: Iterable[Array]) -> Array:
        terms = [x if factor == 1 else -x if factor == -1 else factor * x for factor, x in zip(row, arrays, strict=True) if factor]
        return functools.reduce(jnp.add, terms)

    left = [[combine(row, column) for column in zip(*parts, strict=True)] for row in matrix]
    return [combine(row, line) for line in left for row in matrix]


def _sum_over_images(visit: Callable[..., Array], numbers: int, *arrays: Array) -> Array:
    """Sum `visit` over chunks of images; `numbers` is the size of its intermediate result per image. Images of zeros must add 0."""
    chunk = _images_per_chunk(arrays[0], numbers)
    if chunk == len(arrays[0]):
        return visit(*arrays)
    chunks = tuple(split(x, 0, chunk) for x in arrays)
    start = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(visit, *(x[0] for x in chunks)))
    return jax.lax.scan(lambda total, parts: (total + visit(*parts), None), start, chunks)[0]


def _images_per_chunk(x: Array, numbers: int) -> int:
    return chunk_length(len(x), NUMBERS_PER_CHUNK // numbers)
