"""Recorded cases: inputs and outputs of the PyTorch network in one `.npz`, with weights that are a function of name and seed.

Layout is PyTorch's, channels second. Inputs: `src`, `tgt` `[B, 3, N]`, `views` `[B, V, 3, H, W]`, `R_gt`, `t_gt`, and in training
mode `src_idx` `[B, K]`. Outputs: every stage under the names that the twin returns; large ones as `<name>/stats` and `<name>/head`.
Training also records `grad_norm/<parameter>` and `buffer_sum/<buffer>`. Numpy only.
"""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray]
HEAD, STRIDE = 8, 997


@dataclass(frozen=True)
class Inputs:
    """What a case was computed from, channels second."""

    src: NDArray
    tgt: NDArray
    views: NDArray
    R_gt: NDArray
    t_gt: NDArray
    src_idx: NDArray | None = None


@dataclass(frozen=True)
class Case:
    """Inputs and the recorded outputs."""

    inputs: Inputs
    outputs: Arrays

    @property
    def training(self) -> bool:
        """Whether it was recorded in training mode (batch statistics, losses)."""
        return self.inputs.src_idx is not None

    @property
    def keypoints(self) -> int:
        """Keypoints K per cloud."""
        return self.outputs["it0/logit"].shape[1]

    @property
    def iterations(self) -> int:
        """Iterations n that were recorded."""
        return 1 + max(int(match[1]) for key in self.outputs if (match := re.match(r"it(\d+)/", key)))


@dataclass(frozen=True)
class Run:
    """What one pass of a network gave, under PyTorch names and in its layout.

    Attributes:
        outputs: every intermediate result by its recorded name; in training mode also `loss_terms` and `loss`.
        gradients: by parameter, those that have one; empty in evaluation mode.
        buffers: running statistics after the pass.
        cotangents: derivatives of the loss by intermediate results, where the network recorded them.
    """

    outputs: Arrays
    gradients: Arrays
    buffers: Arrays
    cotangents: Arrays = field(default_factory=dict)

    def recorded(self, key: str) -> NDArray | None:
        """Return what a case stores under `key`; None if the run has no such number."""
        kind, _, name = key.partition("/")
        if kind == "grad_norm":
            return np.asarray(np.linalg.norm(self.gradients[name].ravel())) if name in self.gradients else None
        if kind == "buffer_sum":
            return np.asarray(self.buffers[name].sum()) if name in self.buffers else None
        return recorded_form(key, self.outputs)


def read_case(path: str | Path) -> Case:
    """Read a case.

    Raises:
        ValueError: not an `.npz` file, or without the arrays that a case needs, or with arrays of other shapes.
    """
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            if not isinstance(file, np.lib.npyio.NpzFile):
                raise ValueError("one array, not an archive of arrays")
            arrays = {key: file[key] for key in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path}: expected a recorded case (.npz): {error}") from error
    names = ["src", "tgt", "views", "R_gt", "t_gt"]
    missing = [name for name in (*names, "it0/logit", "R", "t") if name not in arrays]
    if missing:
        raise ValueError(f"{path}: expected a recorded case, but it has no {', '.join(missing)}")
    inputs = Inputs(**{name: arrays.pop(name) for name in names}, src_idx=arrays.pop("src_idx", None))
    _check_shapes(path, inputs)
    return Case(inputs, arrays)


def write_case(path: str | Path, case: Case) -> None:
    """Write a case that `read_case` reads."""
    arrays: dict[str, Any] = {key: value for key, value in vars(case.inputs).items() if value is not None}
    arrays.update(case.outputs)
    np.savez_compressed(path, **arrays)


def named_weights(shapes: Mapping[str, Sequence[int]], seed: int) -> Arrays:
    """Return deterministic float64 weights: each tensor is drawn from a generator seeded with `seed` and its name.

    Args:
        shapes: name -> shape in PyTorch's layout.
        seed: the seed of the case.
    """
    return {name: _named_weight(name, tuple(shape), seed) for name, shape in shapes.items()}


def _named_weight(name: str, shape: tuple[int, ...], seed: int) -> NDArray:
    kind = name.split(".")[-1]
    if kind == "num_batches_tracked":
        return np.zeros((), np.int64)
    if name == "head.reflect":
        return np.diag([1.0, 1.0, -1.0])
    normal = np.random.default_rng([seed, zlib.crc32(name.encode())]).standard_normal(shape)
    if kind == "running_var":
        value = 1 + 0.2 * np.abs(normal)
    elif kind in ("running_mean", "bias", "b_2"):
        value = 0.1 * normal
    elif kind == "a_2" or len(shape) == 1:  # scales of norms
        value = 1 + 0.1 * normal
    else:  # He, by fan-in
        value = normal * np.sqrt(2.0 / np.prod(shape[1:]))
    return np.asarray(value, np.float64)


def recorded_form(key: str, values: Mapping[str, NDArray]) -> NDArray | None:
    """Return what a case stores under `key`, given whole arrays by name; None if there is no such array."""
    if key in values:
        return values[key]
    name, _, form = key.rpartition("/")
    if form not in ("stats", "head") or name not in values:
        return None
    return stats(values[name]) if form == "stats" else values[name][..., :HEAD]


def stats(value: NDArray) -> NDArray:
    """Return mean, population standard deviation, largest absolute value and the sum of every 997th element."""
    return np.array([value.mean(), value.std(), np.abs(value).max(), value.ravel()[::STRIDE].sum()])


def condensed(outputs: Mapping[str, NDArray]) -> Arrays:
    """Replace the large features of a training case by their `stats` and `head`."""
    kept: Arrays = {}
    for key, value in outputs.items():
        if value.ndim == 3 and key.startswith(("feat_", "attn_")):
            kept |= {f"{key}/stats": stats(value), f"{key}/head": value[..., :HEAD]}
        else:
            kept[key] = value
    return kept


def random_inputs(seed: int, pairs: int, points: int, views: int, size: int) -> Inputs:
    """Make inputs: bumpy ellipsoids, cropped alike after a pose, permuted, with a little noise; smooth random images.

    Args:
        seed: of everything.
        pairs, points, views: B, N, V.
        size: height and width of a view, pixels.
    """
    rng = np.random.default_rng(seed)
    clouds = [_random_pair(rng, points) for _ in range(pairs)]
    src, tgt, R_gt, t_gt = (np.stack(parts) for parts in zip(*clouds, strict=True))
    coarse = rng.standard_normal((pairs, views, 3, size // 8 + 1, size // 8 + 1)).repeat(8, -1).repeat(8, -2)[..., :size, :size]
    images = coarse + 0.3 * rng.standard_normal((pairs, views, 3, size, size))
    src, tgt, images = (np.asarray(x, np.float32) for x in (src, tgt, images))
    return Inputs(src, tgt, images, R_gt, t_gt)


def _random_pair(rng: np.random.Generator, points: int) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    direction = rng.standard_normal((4 * points // 3 + 1, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    bumps = 1 + 0.2 * np.sin(direction @ rng.uniform(2, 5, (3, 3))).sum(1, keepdims=True) / 3
    cloud = direction * bumps * rng.uniform(0.4, 1, 3)
    cloud = cloud[np.argsort(np.linalg.norm(cloud - rng.uniform(1, 2, 3), axis=1))[:points]]
    R, t = _random_rotation(rng), rng.uniform(-0.5, 0.5, 3)
    moved = cloud @ R.T + t + np.clip(rng.normal(0, 0.005, cloud.shape), -0.02, 0.02)
    return rng.permutation(cloud).T, rng.permutation(moved).T, R, t


def _random_rotation(rng: np.random.Generator) -> NDArray:
    R = np.eye(3)
    for first, second in ((1, 2), (0, 2), (0, 1)):
        angle = rng.uniform(0, np.pi / 4)
        turn = np.eye(3)
        turn[[first, first, second, second], [first, second, first, second]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
        R = R @ turn
    return R


def _check_shapes(path: str | Path, inputs: Inputs) -> None:
    B, N = len(inputs.src), inputs.src.shape[-1]
    expected: dict[str, tuple[int | None, ...]] = {
        "src": (B, 3, N),
        "tgt": (B, 3, N),
        "views": (B, None, 3, None, None),
        "R_gt": (B, 3, 3),
        "t_gt": (B, 3),
        "src_idx": (B, None),
    }
    for name, shape in expected.items():
        value = getattr(inputs, name)
        if value is not None and (
            value.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, value.shape, strict=True))
        ):
            raise ValueError(f"{path}: {name} has shape {value.shape}, expected {shape}")
