"""What helps a network to find starts for a refinement: CMIGNet and the patch transformer, changed one thing at a time, others beside them.

For `--scale short` or `full`: the others set the numbers of points and keypoints that some rows change.
"""

from __future__ import annotations

from collections.abc import Iterator

from cmig_jax.config import Config
from cmig_jax.config_json import flat
from cmig_jax.experiments.schema import Experiment, Flags, Row

from .methods import idam, rpmnet
from .quickstart import own_clouds_cmignet

POINTS: Flags = {"model.fusion.image": "none", "model.loss.cross_modal": "off"}
NEAR: Flags = {**POINTS, "model.loss.match_threshold": 0.1}
"""The points of two samplings of 384 lie about 0.1 apart, so that most have no partner within 0.05."""

CMIGNET: dict[str, Flags] = {
    "CMIGNet": {},
    "CMIGNet, without images": POINTS,
    "CMIGNet, partners within 0.1": NEAR,
    "CMIGNet + 128 keypoints": {**NEAR, "model.keypoints.count": 128},
    "CMIGNet + features anew": {**NEAR, "model.matching.features": "anew"},
    "CMIGNet + point pairs": {**NEAR, "model.points.local": "pairs", "data.normals": "observed"},
    "CMIGNet + Sinkhorn": {**NEAR, "model.matching.correspondence": "sinkhorn"},
    "CMIGNet + overlap scores": {**NEAR, "model.keypoints.target": "overlap"},
    "CMIGNet + noise to 0.02, crops of 40 to 75 %": {**NEAR, "data.noise": "uniform", "data.noise_std": 0.02, "data.keep_least": 0.4},
    "CMIGNet + 192 points": {**NEAR, "data.points": 256},
    "CMIGNet + 768 points": {**NEAR, "data.points": 1024},
}
VIEWS: Flags = {"views.of": "both", "views.count": 6, "views.size": 32, "views.layout": "axes"}
PATCHES: dict[str, Flags] = {
    "patch transformer": {},
    "noise of 0.01, crops of 75 %": {"data.noise": "fixed", "data.noise_std": 0.01, "data.keep_least": 0.0},
    "in the frames of objects": {"data.frame": "object"},
    "128 patches": {"model.patches": 128},
    "2 layers": {"model.layers": 2},
    "192 channels": {"model.dim": 192},
    "+ features of pixels": {**VIEWS, "model.image": "pixels"},
    "+ a feature per view": {**VIEWS, "model.image": "views"},
    "without images, for as long": {"optim.epochs": 35},
    "trained on real objects": {"data.source": "modelnet40-hdf5", "optim.epochs": 68},
}
PATCH_EPOCHS = 25
"""A fifth of them are 28,800 pairs, which two cores make in less time than CMIGNet's 5,760; as many are 68 epochs of real objects. With
images, 25 take as long as 35 without."""
VALIDATION: Flags = {
    "data.source": "modelnet40-hdf5",
    "data.tested": "validation",
    "data.frame": "object",
    "data.points": 512,
    "data.noise": "fixed",
    "data.noise_std": 0.01,
    "data.keep_least": 0.0,
}
"""Trained on generated objects, rows are judged on pairs of real ones, the same for all, of which no other experiment makes test pairs."""


def _as_own_clouds(preset: Config, learning_rate: float) -> Flags:
    """Return what makes another network's preset train on the data, and by the optimiser, of CMIGNet's rows; with its own learning rate."""
    ours, its = flat(own_clouds_cmignet()), flat(preset)
    same = {flag: value for flag, value in ours.items() if flag.startswith(("data.", "optim.")) and value != its[flag]}
    return {**same, "optim.learning_rate": learning_rate}


def _patch_rows() -> Iterator[tuple[str, Flags, Flags]]:
    for label, flags in PATCHES.items():
        yield label, flags, VALIDATION
        if not flags:
            yield "the same, one pass", flags, {**VALIDATION, "model.passes": 1}
        if not flags or "data.frame" in flags:
            yield f"{label}, tested in any frame", flags, {**VALIDATION, "data.frame": "any"}


STARTS = Experiment(
    "starts for a refinement: what helps the network that comes with the package, on held-out real objects",
    {"data.source": "shapes", "data.normals": "observed"},
    (
        *(
            Row(label, "own-clouds-cmignet", flags, test={**VALIDATION, "model.keypoints.test_count": 384})
            for label, flags in CMIGNET.items()
        ),
        Row("RPM-Net", "rpmnet", _as_own_clouds(rpmnet(), 5e-4), test=VALIDATION),
        Row("IDAM", "idam", _as_own_clouds(idam(), 2e-3), test=VALIDATION),
        *(Row(label, "own-clouds", {"optim.epochs": PATCH_EPOCHS, **flags}, test=test) for label, flags, test in _patch_rows()),
    ),
    columns=("iso_r_deg_median", "iso_t_median", "recall_15_deg", "recall_10_deg", "recall", "seconds_per_pair"),
    drawn=("recall_15_deg", "recall_10_deg"),
)
