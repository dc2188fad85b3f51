"""What helps the network that comes with the package: its preset, changed one thing at a time, on validation pairs of real objects.

For `--scale short` or `full`: the others set the numbers of points and keypoints that some rows change.
"""

from __future__ import annotations

from cmig_jax.config import Config
from cmig_jax.config_json import flat
from cmig_jax.experiments.schema import Experiment, Flags, Row

from .methods import idam, rpmnet
from .quickstart import own_clouds

POINTS: Flags = {"model.fusion.image": "none", "model.loss.cross_modal": "off"}
NEAR: Flags = {**POINTS, "model.loss.match_threshold": 0.1}
"""The points of two samplings of 384 lie about 0.1 apart, so that most have no partner within 0.05."""

CHANGES: dict[str, Flags] = {
    "as it is": {},
    "without images": POINTS,
    "partners within 0.1": NEAR,
    "+ 128 keypoints": {**NEAR, "model.keypoints.count": 128},
    "+ features anew": {**NEAR, "model.matching.features": "anew"},
    "+ point pairs": {**NEAR, "model.points.local": "pairs", "data.normals": "observed"},
    "+ Sinkhorn": {**NEAR, "model.matching.correspondence": "sinkhorn"},
    "+ overlap scores": {**NEAR, "model.keypoints.target": "overlap"},
    "+ noise to 0.02, crops of 40 to 75 %": {**NEAR, "data.noise": "uniform", "data.noise_std": 0.02, "data.keep_least": 0.4},
    "+ 192 points": {**NEAR, "data.points": 256},
    "+ 768 points": {**NEAR, "data.points": 1024},
}
VALIDATION: Flags = {
    "data.source": "modelnet40-hdf5",
    "data.tested": "validation",
    "data.points": 512,
    "data.noise": "fixed",
    "data.noise_std": 0.01,
    "data.keep_least": 0.0,
}
"""Trained on generated objects, rows are judged on pairs of real ones, the same for all, of which no other experiment makes test pairs."""


def _as_own_clouds(preset: Config, learning_rate: float) -> Flags:
    """Return what makes another network's preset train on the data, and by the optimiser, of `own-clouds`; with its own learning rate."""
    ours, its = flat(own_clouds()), flat(preset)
    same = {flag: value for flag, value in ours.items() if flag.startswith(("data.", "optim.")) and value != its[flag]}
    return {**same, "optim.learning_rate": learning_rate}


STARTS = Experiment(
    "starts for a refinement: what helps the network that comes with the package, on held-out real objects",
    {"data.source": "shapes", "data.normals": "observed"},
    (
        *(Row(label, "own-clouds", flags, test={**VALIDATION, "model.keypoints.test_count": 384}) for label, flags in CHANGES.items()),
        Row("RPM-Net", "rpmnet", _as_own_clouds(rpmnet(), 5e-4), test=VALIDATION),
        Row("IDAM", "idam", _as_own_clouds(idam(), 2e-3), test=VALIDATION),
    ),
    columns=("iso_r_deg_median", "iso_t_median", "recall_15_deg", "recall_10_deg", "recall", "seconds_per_pair"),
)
