"""Cases for the tests: recorded with the twin, and the one that comes with the package, which is cut from two whole ones."""

import os
from pathlib import Path

import numpy as np

from cmig_jax.files import replacing
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.parity.cases import EVALUATION, NAMES, PACKED, Arrays, Case, as_recorded, read_cases, stats
from cmig_jax.parity.cmignet_check import flags_of_case
from cmig_jax.parity.cmignet_compare import run_twin
from cmig_jax.parity.cmignet_layout import layout
from cmig_jax.parity.cmignet_run import INPUTS, TRAINING_INPUTS
from cmig_jax.parity.cmignet_ties import recorded_choices
from cmig_jax.parity.cmignet_twin import Twin
from cmig_jax.parity.weights import named_weights

GOLDEN = Path(os.environ.get("CMIG_SHARED", Path(__file__).parents[3] / "shared")) / "golden"
MOST_NUMBERS = 32


def record(flags: CMIGNetFlags, inputs: Arrays, train: bool, seed: int) -> Case:
    """Record a case with the twin, in float64, with the weights that `seed` names: training as sums and summaries, evaluation whole."""
    run = run_twin(Twin(flags, named_weights(layout(flags), seed)), inputs, train, seed)
    if not train:
        return Case(inputs, run)
    drawn, kept = run.pop("src_idx").astype(np.int32), {}
    for name, value in run.items():
        kind, _, rest = name.partition("/")
        summaries = {"gradient": [f"grad_norm/{rest}"], "statistics": [f"buffer_sum/{rest}"]}.get(kind, [name])
        if value.ndim == 3 and name.startswith(("feat_", "attn_")):
            summaries = [f"{name}/stats", f"{name}/head"]
        kept |= {key: as_recorded(key, run) for key in summaries}
    return Case(inputs | {"src_idx": drawn}, kept)


def read_whole(path: Path) -> Case:
    """Read a file that holds one case."""
    (case,) = read_cases(path, INPUTS, TRAINING_INPUTS)
    return case


def write_case(path: Path, case: Case) -> None:
    """Write a case, one entry per array."""
    np.savez_compressed(path, **case.inputs, **case.outputs)


def cut(case: Case) -> Arrays:
    """Keep of a case's outputs what is small, of the others `stats` and a small `head`, and what was chosen.

    That suffices to compare with: every element of an output takes part in its mean and deviation, and every gradient in its norm.
    """
    kept: Arrays = {}
    for key, value in case.outputs.items():
        if value.size <= MOST_NUMBERS:
            kept[key] = value
        elif not key.endswith("/head"):
            kept[f"{key}/stats"] = stats(value)
            if value[..., :8].size <= MOST_NUMBERS:
                kept[f"{key}/head"] = value[..., :8]
    return kept | recorded_choices(case, flags_of_case(case).keypoints.count)


def write_released(path: Path, training: Case, evaluation: Case) -> None:
    """Write `cmig_jax/parity/released.npz` from two whole cases on the same inputs: `train_seed0.npz` and `eval_seed0.npz`.

    The outputs share one array, since an entry of an archive takes more room than most of them do.
    """
    assert all(np.array_equal(training.inputs[name], value) for name, value in evaluation.inputs.items())
    outputs = cut(training) | {EVALUATION + key: value for key, value in cut(evaluation).items()}
    names = np.array([" ".join([name, *map(str, value.shape)]) for name, value in outputs.items()])
    packed = np.concatenate([value.ravel().astype(np.float64) for value in outputs.values()])
    with replacing(path) as file:
        np.savez_compressed(file, **training.inputs, **{PACKED: packed, NAMES: names.astype("S")})
