"""Every table and figure of the paper's experiments as data, and ours.

An experiment is a protocol and rows. A row is a preset and the few flags that it changes; flags that change at test time only are
separate. Angles in degrees, lengths in units of the normalised object. `quoted` figures are the paper's, on ModelNet40 (or
7-Scenes), and were not measured here. `cmig experiments` runs them.
"""

from __future__ import annotations

from cmig_jax.data.protocol import SYMMETRIC
from cmig_jax.experiments.schema import Experiment, Flags, Quoted, Row

from .compared import PROTOCOL, compared
from .starts import STARTS

UNCHANGED: Flags = {}
CLEAN: Flags = {**PROTOCOL, "data.noise_std": 0.0}
NOISE: Flags = {**PROTOCOL, "data.noise_std": 0.01, "data.noise_clip": 0.05}
UNSEEN = {"data.categories": "first-half", "data.test_categories": "second-half"}

NO_IMAGES = {"model.fusion.image": "none", "model.loss.cross_modal": "off"}
NO_CONTRAST = {"model.loss.overlap": False, "model.loss.cross_modal": "off"}
ALL_KEYPOINTS = {"model.keypoints.test_count": 768}
REPEATED = {"model.matching.repeats": 5}
SOFT = {"model.matching.correspondence": "soft"}
AT_TEST = ALL_KEYPOINTS | REPEATED | SOFT
AS_TRAINED = {"model.keypoints.test_count": 0, "model.matching.repeats": 0, "model.matching.correspondence": "hard"}
AS_RECORDED = {"data.sampling": "twice", "data.crop": "independent", "data.turn": "either"}
OBSERVED = {"views.of": "both"}  # a recording has no complete object to render
CORRECTIONS: dict[str, Flags] = {
    "own scores": {"model.keypoints.score_from": "own"},
    "linear scores": {"model.keypoints.activation": "linear"},
    "own and linear scores": {"model.keypoints.score_from": "own", "model.keypoints.activation": "linear"},
    "random keypoints": {"model.keypoints.select": "random"},
    "weighted centroids": {"model.pose.centroid": "weighted"},
    "view tokens": {"model.fusion.image": "views"},
    "observed views": OBSERVED,
    "distance labels": {"model.loss.credibility_label": "distance"},
}


def _three_presets(quoted: Quoted | None = None, test: Flags = UNCHANGED) -> tuple[Row, ...]:
    """The paper's text, the released network and ours; the quoted figures belong to the first."""
    return (
        Row("paper", "paper", test=test, quoted=quoted),
        Row("released", "released", test=test),
        Row("corrected", "corrected", test=test),
    )


def _recorded(source: str) -> tuple[Row, ...]:
    """The three presets on recorded pairs, and ours refined by ICP and by generalised ICP."""
    test = {"data.source": source} | OBSERVED
    return (
        *_three_presets(test=test),
        Row("corrected, then ICP", "corrected", test=test, then="ICP"),
        Row("corrected, then GICP", "corrected", test=test, then="GICP"),
    )


FULL = Quoted(1.472, 0.632, 0.0058, 0.0036)

EXPERIMENTS: dict[str, Experiment] = {
    "table1": Experiment(
        "same categories in training and test, no noise",
        CLEAN,
        (*compared("table1"), *_three_presets(Quoted(0.772, 0.408, 0.0048, 0.0030))),
        baselines=True,
    ),
    "table2": Experiment(
        "unseen categories, no noise",
        {**CLEAN, **UNSEEN},
        (*compared("table2"), *_three_presets(Quoted(0.842, 0.431, 0.0046, 0.0029))),
        baselines=True,
    ),
    "table3": Experiment("same categories, Gaussian noise", NOISE, (*compared("table3"), *_three_presets(FULL)), baselines=True),
    "table4": Experiment(
        "Gaussian noise with lower overlap: a crop for each cloud on its own",
        {**NOISE, "data.crop": "independent"},
        (*compared("table4"), *_three_presets(Quoted(4.341, 2.279, 0.0214, 0.0104))),
        baselines=True,
    ),
    "table5": Experiment(
        "7-Scenes: trained on six scenes, tested on Office, 2,048 points cropped to 1,536",
        {**CLEAN, "data.source": "sevenscenes", "data.points": 2048},
        (*compared("table5"), *_three_presets(Quoted(0.804, 0.488, 0.0032, 0.0018))),
        baselines=True,
    ),
    "table6": Experiment(
        "components: TF transformer, CMD cross-modal layer, MCL contrastive losses, MP predicted keypoints",
        NOISE,
        (
            Row(
                "none",
                "paper",
                {"model.fusion.points": "none", "model.fusion.image": "none", "model.keypoints.select": "random"} | NO_CONTRAST,
                quoted=Quoted(3.565, 1.529, 0.0194, 0.0081),
            ),
            Row(
                "TF",
                "paper",
                {"model.fusion.image": "none", "model.keypoints.select": "random"} | NO_CONTRAST,
                quoted=Quoted(3.106, 1.299, 0.0137, 0.0064),
            ),
            Row("TF + CMD", "paper", {"model.keypoints.select": "random"} | NO_CONTRAST, quoted=Quoted(2.537, 1.026, 0.0106, 0.0069)),
            Row("TF + CMD + MCL", "paper", {"model.keypoints.select": "random"}, quoted=Quoted(1.708, 0.713, 0.0066, 0.0039)),
            Row("TF + CMD + MCL + MP", "paper", quoted=FULL),
        ),
    ),
    "table7": Experiment(
        "iterations n of correspondence search and pose",
        NOISE,
        (
            Row("n = 2", "paper", {"model.matching.iterations": 2}, quoted=Quoted(1.972, 0.748, 0.0084, 0.0041)),
            Row("n = 3", "paper", quoted=FULL),
            Row("n = 4", "paper", {"model.matching.iterations": 4}, quoted=Quoted(1.564, 0.664, 0.0063, 0.0037)),
            Row("n = 5", "paper", {"model.matching.iterations": 5}, quoted=Quoted(1.556, 0.668, 0.0063, 0.0038)),
        ),
    ),
    "table8": Experiment(
        "correspondence search: regression of the pose, features with coordinates, features and coordinates apart",
        NOISE,
        (
            # No loss trains scores where there is no matching: with predicted keypoints PCRNet would see random ones.
            Row(
                "PCRNet",
                "paper",
                {"model.matching.head": "pcrnet", "model.keypoints.select": "all"},
                quoted=Quoted(14.811, 5.720, 0.0525, 0.0274),
            ),
            Row("IDAM", "paper", {"model.matching.head": "idam"}, quoted=Quoted(2.790, 1.079, 0.0104, 0.0051)),
            Row("CMIGNet", "paper", quoted=FULL),
        ),
    ),
    "figure7": Experiment(
        "Stanford models, 10,000 points, by networks trained on ModelNet40",
        NOISE,
        _three_presets(test={"data.source": "stanford", "data.points": 10000}),
        baselines=True,
    ),
    "figure8": Experiment(
        "noise of standard deviation 0.02 to 0.06, in training and test",
        {},
        tuple(Row(f"{std:.2f}", "paper", {"data.noise_std": std}) for std in (0.02, 0.03, 0.04, 0.05, 0.06)),
    ),
    "figure9": Experiment(
        "contrastive losses: overlapping (OCL), cross-modal (CMCL)",
        NOISE,
        (
            Row("OCL + CMCL", "paper"),
            Row("OCL", "paper", {"model.loss.cross_modal": "off"}),
            Row("CMCL", "paper", {"model.loss.overlap": False}),
            Row("neither", "paper", NO_CONTRAST),
        ),
    ),
    "corrections": Experiment(
        "what each correction of the released network brings on its own: unseen categories with noise",
        {**NOISE, **UNSEEN},
        (
            Row("released", "released"),
            *(Row(f"released + {name}", "released", flags) for name, flags in CORRECTIONS.items()),
            Row("released + all keypoints at test", "released", test=ALL_KEYPOINTS),
            Row("released + repeated last iteration at test", "released", test=REPEATED),
            Row("released + soft partners at test", "released", test=SOFT),
            Row("released + all three at test", "released", test=AT_TEST),
            *(Row(f"released + {name} + all three at test", "released", flags, test=AT_TEST) for name, flags in CORRECTIONS.items()),
            Row("corrected without the three", "corrected", test=AS_TRAINED),
            Row("corrected", "corrected"),
            Row("released, then ICP", "released", then="ICP"),
            Row("corrected, then ICP", "corrected", then="ICP"),
        ),
        baselines=True,
    ),
    "twice": Experiment(
        "the clouds of a pair sampled independently: at test only, and in training too",
        {**NOISE, **UNSEEN},
        (
            Row("released", "released", test={"data.sampling": "twice"}),
            Row("released + all three at test", "released", test={"data.sampling": "twice"} | AT_TEST),
            Row("corrected", "corrected", test={"data.sampling": "twice"}),
            Row("released, trained so", "released", {"data.sampling": "twice"}),
            Row("released, trained so, + all three at test", "released", {"data.sampling": "twice"}, test=AT_TEST),
            Row("corrected, trained so", "corrected", {"data.sampling": "twice"}),
            Row("released, then ICP", "released", test={"data.sampling": "twice"}, then="ICP"),
            Row("corrected, then ICP", "corrected", test={"data.sampling": "twice"}, then="ICP"),
            Row("released, trained so, then ICP", "released", {"data.sampling": "twice"}, then="ICP"),
            Row("corrected, trained so, then ICP", "corrected", {"data.sampling": "twice"}, then="ICP"),
            Row("released, trained so, then GICP", "released", {"data.sampling": "twice"}, then="GICP"),
            Row("corrected, trained so, then GICP", "corrected", {"data.sampling": "twice"}, then="GICP"),
            *compared(flags={"data.sampling": "twice"}, suffix=", trained so"),
        ),
        baselines=True,
    ),
    "turns": Experiment(
        "rotations to either side, whose mean tells a method nothing; the mean of the paper's rotations to one side is half the pose",
        {**NOISE, **UNSEEN, "data.turn": "either"},
        (
            *compared(),
            *_three_presets(),
            Row("corrected, trained on one side", "corrected", {"data.turn": "positive"}, test={"data.turn": "either"}),
            Row("released, then ICP", "released", then="ICP"),
            Row("corrected, then ICP", "corrected", then="ICP"),
        ),
        baselines=True,
    ),
    "images": Experiment(
        "do the images matter? real, those of another object, black, or a network without any",
        {**NOISE, **UNSEEN},
        (
            *(Row(f"released, {shown}", "released", test={"views.shown": shown}) for shown in ("real", "shuffled", "zero")),
            *(Row(f"corrected, {shown}", "corrected", test={"views.shown": shown}) for shown in ("real", "shuffled", "zero")),
            Row("corrected without images", "corrected", NO_IMAGES),
        ),
    ),
    "symmetric": Experiment(
        "ModelNet40's eight symmetric categories left out", {**NOISE, "data.exclude": SYMMETRIC}, _three_presets(), baselines=True
    ),
    "rpmnet": Experiment(
        "RPM-Net's protocol: each cloud from a subset of the points, a half-space crop each that keeps 70 %, unseen categories",
        {**NOISE, **UNSEEN, "data.sampling": "subsets", "data.crop": "half-space", "data.keep": 0.7},
        (*compared(), *_three_presets()),
        baselines=True,
    ),
    "scans": Experiment(
        "raw range scans of the Stanford bunny and the like, true partial pairs, by networks trained on clouds as independent as these",
        {**NOISE, **AS_RECORDED},
        _recorded("stanford-scans"),
        baselines=True,
    ),
    "fragments": Experiment(
        "neighbouring fragments of 7-Scenes, true partial pairs, by networks trained on clouds as independent as these",
        {**NOISE, **AS_RECORDED},
        _recorded("sevenscenes-fragments"),
        baselines=True,
    ),
    "starts": STARTS,
}
