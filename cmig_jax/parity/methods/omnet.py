"""OMNet (the PyTorch port of its authors): where its `state_dict` goes, and the names of its recorded results."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from cmig_jax.models.omnet.network import OMNetFlags, near_pairs, overlap_labels
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.layers import linear, normalisation
from cmig_jax.parity.method import Method, Outcome, channels_second
from cmig_jax.parity.weights import Layout, Tensor
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

CLOUDS = ("src", "tgt")
# Added to the class bias of the random weights in each iteration, so that the masks keep a part of the points.
SHIFTS = {True: (0.94, 0.93, 1.55, -0.32), False: (1.16, 1.31, 0.14, -0.41)}


def _layout(flags: OMNetFlags) -> Layout:
    iterations = range(flags.iterations)
    encoder = (3, *flags.local_widths, *flags.global_widths)
    local, fused = len(flags.local_widths), flags.fusion_widths[-1]
    encoder_paths = [*_paths("local", local), *_paths("global", len(flags.global_widths))]
    fusion = (flags.local_widths[-1] + 2 * flags.global_widths[-1], *flags.fusion_widths)
    fusion_paths = [("first/layer", "first_norm"), *_paths("rest", len(flags.fusion_widths) - 1)]
    decoder_paths = [path for i in range(len(flags.decoder_widths)) for path in _paths(f"block_{i}", 1)]
    regression = (2 * (fused + sum(flags.decoder_widths)), *flags.regression_widths)
    regression_paths = _paths("hidden", len(flags.regression_widths))
    last = len(flags.decoder_widths) + 1
    tensors = []
    for i in iterations:
        tensors += _blocks(f"encoder.{i}.conv_block", encoder, f"stages_{i}/encoder", encoder_paths)
    for i in iterations:
        tensors += _blocks(f"fusion.{i}.conv_block", fusion, f"stages_{i}/fusion", fusion_paths)
    for i in iterations:
        tensors += _blocks(f"decoder.{i}.conv_block", (fused, *flags.decoder_widths), f"stages_{i}/decoder", decoder_paths)
        tensors += linear(f"decoder.{i}.conv_block{last}.0", (2, flags.decoder_widths[-1], 1), f"stages_{i}/decoder/logits")
    for i in iterations:
        tensors += _blocks(f"regression.{i}.fc_block", regression, f"stages_{i}/regression", regression_paths, unit=())
        tensors += linear(f"regression.{i}.final_fc.0", (7, regression[-1]), f"stages_{i}/regression/last")
    return tensors


def _paths(module: str, layers: int) -> list[tuple[str, str]]:
    """Return where the linear layers and the norms of a `NormedMLP` stand."""
    return [(f"{module}/layer_{i}", f"{module}/norm_{i}") for i in range(layers)]


def _blocks(name: str, sizes: tuple[int, ...], module: str, paths: list[tuple[str, str]], unit: tuple[int, ...] = (1,)) -> Iterator[Tensor]:
    """List blocks of a linear layer with bias and its BatchNorm, `<name>1`, `<name>2`, ..., whose paths are inside `module`."""
    for i, ((inputs, width), (layer, norm)) in enumerate(zip(itertools.pairwise(sizes), paths, strict=True), 1):
        yield from linear(f"{name}{i}.0", (width, inputs, *unit), f"{module}/{layer}")
        yield from normalisation(f"{name}{i}.1", width, f"{module}/{norm}")


def _flags_of_state(state: State) -> OMNetFlags:
    iterations = sum(name.endswith("final_fc.0.weight") for name in state)
    widths = {part: _widths(state, part) for part in ("encoder", "fusion", "decoder", "regression")}
    if not iterations or not all(widths.values()):
        raise ValueError("expected a state of OMNet: encoder.0.conv_block1.0.weight, ..., regression.0.final_fc.0.weight")
    return OMNetFlags(
        iterations=iterations,
        local_widths=widths["encoder"][:2],
        global_widths=widths["encoder"][2:],
        fusion_widths=widths["fusion"],
        decoder_widths=widths["decoder"],
        regression_widths=widths["regression"],
    )


def _widths(state: State, part: str) -> tuple[int, ...]:
    """Return the widths of the first iteration's blocks with a BatchNorm."""
    names = (f"{part}.0.{'fc' if part == 'regression' else 'conv'}_block{i}.1.weight" for i in itertools.count(1))
    return tuple(len(state[name]) for name in itertools.takewhile(lambda name: name in state, names))


def _overrides(case: Case) -> dict[str, tuple[str, object]]:
    shifts = SHIFTS[any(key.startswith("grad_norm/") for key in case.outputs)]
    changes: dict[str, tuple[str, object]] = {}
    for i, shift in enumerate(shifts):
        changes[f"regression.{i}.final_fc.0.weight"] = ("*", 0.1)
        changes[f"regression.{i}.final_fc.0.bias"] = ("+", [1.0, 0, 0, 0, 0, 0, 0])
        changes[f"decoder.{i}.conv_block4.0.bias"] = ("+", [0.0, shift])
    return changes


def _batch(inputs: Arrays) -> Batch:
    arrays: dict[str, Any] = inputs
    return Batch(source=arrays["src"], target=arrays["tgt"], target_from_source=RigidTransform(R=arrays["R_gt"], t=arrays["t_gt"]))


def _of_clouds(*names: str) -> Callable[[int], list[str]]:
    """Name the results of a module that is called for the source and then for the target in each iteration."""
    return lambda call: [f"it{call // 2}/{name}_{CLOUDS[call % 2]}" for name in names]


def _results(outcome: Outcome) -> Arrays:
    prediction, stages, inputs = outcome.prediction, outcome.stages, outcome.inputs
    pose = prediction.target_from_source
    results = {**stages, "R": pose.R, "t": pose.t}
    official = {"overlap": "cls", "quaternion": "quat", "translation": "translate"}
    for name, value in outcome.terms.items():
        term, _, i = name.rpartition("_")
        results[f"loss_terms/{official[term]}_{i}"] = value
    with jax.enable_x64(True):
        near = near_pairs(_batch(inputs), OMNetFlags().overlap_threshold)
        poses = jax.tree.map(np.asarray, [step.pose.transform() for step in prediction.steps])
    for i, (step, pose) in enumerate(zip(prediction.steps, poses, strict=True)):
        labels = overlap_labels(near, step.masks)
        for cloud, mask, logits, label in zip(CLOUDS, step.masks, step.logits, labels, strict=True):
            results[f"it{i}/mask_in_{cloud}"] = mask
            results[f"it{i}/logits_{cloud}"] = channels_second(logits)
            results[f"it{i}/label_{cloud}"] = np.asarray(label)
            results[f"it{i}/fused_{cloud}"] = channels_second(stages[f"it{i}/points_{cloud}"])
        results[f"it{i}/src_in"] = step.source
        results[f"it{i}/pooled"] = np.concatenate([stages[f"it{i}/pooled_{cloud}"] for cloud in CLOUDS], axis=-1)
        results |= {f"it{i}/R": pose.R, f"it{i}/t": pose.t}
        results[f"it{i}/pose7_step"] = np.concatenate([stages[f"it{i}/step_{part}"] for part in ("quaternion", "translation")], axis=-1)
        results[f"it{i}/pose7"] = np.concatenate([step.pose.quaternion, step.pose.translation], axis=-1)
    return results


OMNET = Method(
    name="omnet",
    network="omnet",
    flags_of_case=lambda _: OMNetFlags(),
    flags_of_state=_flags_of_state,
    layout=_layout,
    inputs={"src": "B N 3", "tgt": "B N 3", "R_gt": "B 3 3", "t_gt": "B 3", "pose7_gt": "B 7"},
    batch=_batch,
    stages={
        "Encoder.__call__": _of_clouds("local", "glob"),
        "Fusion.__call__": _of_clouds("points"),
        "Decoder.__call__": _of_clouds("last", "pooled"),
        "Stage.__call__": lambda call: [f"it{call}/{name}" for name in ("logits_x", "logits_y", "step_quaternion", "step_translation")],
    },
    results=_results,
    overrides=_overrides,
)
