"""The flags: frozen dataclasses whose defaults are the paper's settings (the `paper` preset).

Every field says its meaning, unit and source ("Sec.", "Eq." and "Table" refer to Xie et al., RA-L 2023) in the docstring below
it, which `--help` shows. Nothing here imports anything of ours, so numpy-only code and JAX code read the same settings.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

Categories = Literal["all", "first-half", "second-half"]


@dataclass(frozen=True)
class DataConfig:
    """Objects and the protocol that turns an object into a pair (Sec. IV-A, IV-B)."""

    source: Literal["shapes", "modelnet40-hdf5", "meshes", "stanford", "sevenscenes", "stanford-scans", "sevenscenes-fragments"] = (
        "modelnet40-hdf5"
    )
    """Kind of data: generated shapes, ModelNet40 HDF5 files, a folder per category of meshes or clouds, Stanford models, 7-Scenes
    fragments as objects; or, to evaluate on, recorded pairs with their true pose: Stanford's raw scans, neighbouring 7-Scenes fragments.
    Of the flags below these know `prepared`, `points`, `keep`, `max-angle-deg` (pairs that turn by more are left out), `test-seed`."""
    root: str | None = None
    """Folder of the raw data (`shapes` needs none)."""
    prepared: str | None = None
    """Folder of the prepared shards; made from `root` when it is missing (default: a folder of its settings under data/)."""
    categories: Categories = "all"
    """Categories to train and validate on (labels below half of them are the first half)."""
    test_categories: Categories = "all"
    """Categories to test on; `second-half` after training on `first-half` is the unseen protocol (Sec. IV-B)."""
    exclude: tuple[str, ...] = ()
    """Names of categories to leave out of training, validation and test, such as those of symmetric objects."""
    shapes: int = 40
    """Generated objects per category and split, for `source=shapes`; the test split has a quarter as many."""
    points: int = 1024
    """Points per object before the crop (Sec. IV-B)."""
    sampling: Literal["once", "twice", "subsets"] = "once"
    """`once`: both clouds start from the same points; `twice`: from independent samplings, no point in both; `subsets`: each from a
    random subset of all prepared points of the object, so that some points are in both (RPM-Net)."""
    keep: float = 0.75
    """Share of the points that the crop keeps (Sec. IV-B removes 25 %)."""
    crop: Literal["shared", "independent", "half-space", "none"] = "shared"
    """Far point of the crop: one for both clouds, one each (lower overlap), a random half-space each (RPM-Net), or no crop."""
    noise_std: float = 0.01
    """Standard deviation of the Gaussian noise on every coordinate, in object units; 0 turns noise off (Sec. IV-B)."""
    noise_clip: float = 0.05
    """Largest absolute noise, in object units (Sec. IV-B)."""
    max_angle_deg: float = 45.0
    """Each of the three Euler angles is uniform in [0, this], degrees (Sec. IV-B)."""
    turn: Literal["positive", "either"] = "positive"
    """`positive`: angles as above; `either`: in [-max_angle_deg, max_angle_deg], since clouds in the wild turn to either side."""
    max_translation: float = 0.5
    """Each translation component is uniform in [-this, this], object units (Sec. IV-B)."""
    validation: float = 0.1
    """Share of the training objects held out to choose the checkpoint; the test split is never used for that."""
    test_seed: int = 1234
    """Seed of the validation and test pairs: pair i is a function of (test_seed, i)."""
    workers: int = 0
    """Loader processes; 0 makes pairs in threads of the training process."""


@dataclass(frozen=True)
class ViewsConfig:
    """Depth projections (Sec. III-A)."""

    of: Literal["object", "source", "target", "both"] = "object"
    """What is rendered: the complete object in the source's frame (ahead of time), or the observed source, target, or each its own."""
    count: int = 20
    """Number of views V: 20 for `dodecahedron`, 6 for `axes`, any for `ring`."""
    size: int = 224
    """Height and width of a view, pixels."""
    layout: Literal["dodecahedron", "ring", "axes"] = "dodecahedron"
    """Where the cameras stand on the unit sphere."""
    shown: Literal["real", "shuffled", "zero"] = "real"
    """Views the network is given: the pair's own, those of another object, or black ones. Tests whether the images matter."""


@dataclass(frozen=True)
class PointsConfig:
    """Point encoder: densely linked EdgeConv layers (Sec. III-A)."""

    k: int = 20
    """Neighbours of the graph, the point itself included."""
    widths: tuple[int, ...] = (64, 64, 64, 128)
    """Channels of the EdgeConv layers."""
    dim: int = 512
    """Channels C of the point features."""


@dataclass(frozen=True)
class ImageConfig:
    """Image encoder: ResNet, maximum over views (Eq. 1)."""

    widths: tuple[int, ...] = (64, 128, 256, 512)
    """Channels of the stages; the last must equal `points.dim`, since the two modalities share one space (Eq. 3)."""
    blocks: tuple[int, ...] = (2, 2, 2, 2)
    """Basic blocks per stage; (2, 2, 2, 2) is ResNet-18."""


@dataclass(frozen=True)
class FusionConfig:
    """Transformer fusion (Sec. III-C; TF and CMD of Table 6)."""

    points: Literal["transformer", "none"] = "transformer"
    """First layer, between the two clouds (TF)."""
    image: Literal["cross-attention", "transformer", "views", "none"] = "cross-attention"
    """Second layer, points to image (CMD): Eq. 8; the first layer's weights once more; Eq. 8 with one token per view; or none."""
    heads: int = 4
    """Attention heads of the transformer."""
    feed_forward: int = 1024
    """Hidden channels of its feed-forward layers."""


@dataclass(frozen=True)
class KeypointsConfig:
    """Mask prediction (Sec. III-D; MP of Table 6)."""

    select: Literal["predicted", "random", "all"] = "predicted"
    """Keypoints: those of the highest scores (in training drawn beside them, so that the scores are learned), random points, or every
    point. A network trained without scores has none to choose by."""
    count: int = 256
    """Keypoints K per cloud."""
    test_count: int = 0
    """Keypoints K at evaluation, at most all points; 0: as many as in training."""
    score_from: Literal["own", "other"] = "own"
    """Whose point features score a cloud's points; `other` (the released network) needs clouds of equal size."""
    activation: Literal["linear", "sigmoid"] = "linear"
    """Last activation of the score; its target is a negative entropy, at most 0, which a sigmoid cannot reach."""


@dataclass(frozen=True)
class MatchingConfig:
    """Correspondence search (Sec. III-E, Tables 7 and 8)."""

    head: Literal["cmignet", "idam", "pcrnet"] = "cmignet"
    """Features and coordinates apart (the paper's), together (IDAM), or a regression of the pose (PCRNet)."""
    iterations: int = 3
    """Iterations n, each with its own weights."""
    repeats: int = 0
    """Further iterations at evaluation, with the weights of the last; 0 is the paper's."""
    correspondence: Literal["hard", "soft"] = "hard"
    """Partner of a source keypoint: the target keypoint that matches best, or the mean of all under the softmax of the matching."""
    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    """Channels of the feature similarity network."""
    coordinate_widths: tuple[int, ...] = (32, 32, 32)
    """Channels of the coordinate similarity network."""


@dataclass(frozen=True)
class PoseConfig:
    """Weighted SVD (Eq. 11)."""

    centroid: Literal["weighted", "unweighted"] = "weighted"
    """Centroids of the covariance: weighted ones minimise Eq. 11, unweighted ones are the released network's."""
    gradient: Literal["stopped", "through"] = "stopped"
    """Whether the pose carries a gradient into the next iteration."""


@dataclass(frozen=True)
class ModelConfig:
    """The network (Fig. 2)."""

    points: PointsConfig = field(default_factory=PointsConfig)
    image: ImageConfig = field(default_factory=ImageConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    keypoints: KeypointsConfig = field(default_factory=KeypointsConfig)
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    pose: PoseConfig = field(default_factory=PoseConfig)


@dataclass(frozen=True)
class LossConfig:
    """The five losses (Sec. III-B and III-F)."""

    overlap: Literal["on", "off"] = "on"
    """Overlapping contrastive loss (Eq. 2)."""
    overlap_mean: Literal["all", "active"] = "all"
    """Eq. 2 divides by all pairs; the released network by those with a non-zero term."""
    margins: tuple[float, float] = (70.0, 3.0)
    """Margins of Eq. 2: positive, negative; feature distance."""
    overlap_threshold: float = 0.01
    """A point overlaps if the other cloud has a point closer than this under the true pose, object units."""
    match_threshold: float = 0.05
    """Two keypoints correspond if they lie closer than this under the true pose, object units."""
    cross_modal: Literal["paper", "nt-xent", "off"] = "paper"
    """Cross-modal contrastive loss: Eq. 6 (no positive in the denominator), NT-Xent (with it), or none."""
    temperature: float = 0.1
    """Temperature of the cross-modal loss (Eq. 4)."""
    credibility_label: Literal["distance", "index"] = "distance"
    """Label of the matching score: correspondence closer than `match_threshold`, or the very same index."""
    match_mean: Literal["all", "positive"] = "all"
    """Correspondence loss averaged over all K, or over those with a true correspondent."""


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its schedule (Sec. IV-A)."""

    learning_rate: float = 1e-4
    """Initial learning rate."""
    weight_decay: float = 1e-3
    """L2 term added to the gradient before Adam's moments."""
    schedule: Literal["step", "cosine"] = "step"
    """`step`: times `decay` at each of `milestones`; `cosine`: linear warm-up over the first 5 %, then cosine to 1 % of the rate."""
    milestones: tuple[int, ...] = (50, 75)
    """Epochs after which the rate is multiplied by `decay`."""
    decay: float = 0.5
    """Factor of the step schedule."""
    epochs: int = 100
    """Passes over the training objects."""
    batch: int = 6
    """Pairs per step over all devices; the last incomplete batch of an epoch is dropped."""
    clip_norm: float = 0.0
    """Largest global gradient norm; 0 is off."""
    validate_every: int = 1
    """Epochs between validations, each of which saves a checkpoint."""


@dataclass(frozen=True)
class ComputeConfig:
    """How it is computed, not what."""

    precision: Literal["float32", "bfloat16"] = "float32"
    """Layers' precision; geometry, normalisation statistics and losses stay in float32."""
    recompute: Literal["off", "on"] = "off"
    """In training, keep the inputs of each image block, fusion pass and iteration and compute the rest again for the derivative: less
    memory, more time."""
    rows: int = 0
    """Largest number of rows per chunk of kNN, attention and matching, which bounds memory. 0: kNN and attention whole, matching in
    chunks that suit the machine."""


@dataclass(frozen=True)
class Config:
    """One run."""

    name: str = "paper"
    """Name of the run folder under runs/."""
    seed: int = 0
    """Seed of the weights, the training pairs and their order."""
    data: DataConfig = field(default_factory=DataConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)

    def __post_init__(self) -> None:
        for name, ok, expected in _rules(self):
            if not ok:
                raise ValueError(f"{name}: expected {expected}")


def _rules(c: Config) -> list[tuple[str, bool, str]]:
    """Ranges, and the flags that exclude each other: (flag and value, holds, what was expected)."""
    d, v, m, o = c.data, c.views, c.model, c.optim
    kept = round(d.points * d.keep) if d.crop != "none" else d.points
    fixed_count = {"dodecahedron": 20, "axes": 6}.get(v.layout, v.count)
    uses_views = m.fusion.image != "none" or c.loss.cross_modal != "off"
    return [
        (f"name = {c.name}", is_inside(c.name), "the name of a folder under runs/"),
        (f"data.points = {d.points}", d.points >= 1, "at least 1"),
        (f"data.keep = {d.keep}", 0 < d.keep <= 1, "a share in (0, 1]"),
        (f"data.noise_std = {d.noise_std}", 0 <= d.noise_std < math.inf, "0 or more"),
        (f"data.noise_clip = {d.noise_clip}", d.noise_clip >= 0, "0 or more"),
        (f"data.max_translation = {d.max_translation}", 0 <= d.max_translation < math.inf, "0 or more"),
        (f"data.test_seed = {d.test_seed}", d.test_seed >= 0, "0 or more"),
        (f"data.workers = {d.workers}", d.workers >= 0, "0 or more"),
        (f"seed = {c.seed}", c.seed >= 0, "0 or more"),
        (f"data.max_angle_deg = {d.max_angle_deg}", 0 <= d.max_angle_deg <= 180, "degrees in [0, 180]"),
        (f"data.validation = {d.validation}", 0 < d.validation < 1, "a share in (0, 1)"),
        (f"data.shapes = {d.shapes}", d.shapes >= 4, "at least 4 per category"),
        (f"views.count = {v.count}", v.count == fixed_count and v.count >= 1, f"{fixed_count} for views.layout={v.layout}"),
        (f"views.size = {v.size}", v.size >= 8, "at least 8 pixels"),
        (f"model.points.k = {m.points.k}", 1 <= m.points.k <= kept, f"1 to {kept}, the points that are left after the crop"),
        (
            f"model.keypoints.count = {m.keypoints.count}",
            m.keypoints.select == "all" or 2 <= m.keypoints.count <= kept,
            f"2 to {kept}, the points that are left after the crop",
        ),
        (f"model.keypoints.test_count = {m.keypoints.test_count}", m.keypoints.test_count >= 0, "0 (as in training) or more"),
        (f"model.points.widths = {m.points.widths}", _positive(m.points.widths), "one or more numbers above 0"),
        (f"model.points.dim = {m.points.dim}", m.points.dim >= 4, "at least 4"),
        (
            f"model.image.widths = {m.image.widths}",
            _positive(m.image.widths) and (not uses_views or m.image.widths[-1] == m.points.dim),
            f"the last one to equal model.points.dim = {m.points.dim}",
        ),
        (
            f"model.image.blocks = {m.image.blocks}",
            len(m.image.blocks) == len(m.image.widths),
            f"{len(m.image.widths)} numbers, one for each of model.image.widths",
        ),
        (
            f"model.fusion.heads = {m.fusion.heads}",
            m.fusion.heads >= 1 and m.points.dim % m.fusion.heads == 0,
            f"a divisor of model.points.dim = {m.points.dim}",
        ),
        (
            "model.fusion.image = transformer with model.fusion.points = none",
            not (m.fusion.image == "transformer" and m.fusion.points == "none"),
            "model.fusion.points = transformer, whose weights it shares",
        ),
        (f"model.fusion.feed_forward = {m.fusion.feed_forward}", m.fusion.feed_forward >= 1, "at least 1"),
        (
            f"model.matching.feature_widths = {m.matching.feature_widths}",
            _positive(m.matching.feature_widths),
            "one or more numbers above 0",
        ),
        (
            f"model.matching.coordinate_widths = {m.matching.coordinate_widths}",
            _positive(m.matching.coordinate_widths),
            "one or more numbers above 0",
        ),
        (f"model.matching.iterations = {m.matching.iterations}", m.matching.iterations >= 1, "at least 1"),
        (f"model.matching.repeats = {m.matching.repeats}", m.matching.repeats >= 0, "0 (none) or more"),
        (f"loss.overlap_threshold = {c.loss.overlap_threshold}", c.loss.overlap_threshold > 0, "above 0"),
        (f"loss.match_threshold = {c.loss.match_threshold}", c.loss.match_threshold > 0, "above 0"),
        (f"loss.margins = {c.loss.margins}", min(c.loss.margins) >= 0, "two distances, 0 or more"),
        (f"loss.temperature = {c.loss.temperature}", c.loss.temperature > 0, "above 0"),
        (
            f"optim.batch = {o.batch} with loss.cross_modal = {c.loss.cross_modal}",
            o.batch >= (1 if c.loss.cross_modal == "off" else 2),
            "at least 2 pairs, since the loss contrasts pairs of one batch (or loss.cross_modal = off)",
        ),
        (f"optim.epochs = {o.epochs}", o.epochs >= 1, "at least 1"),
        (f"optim.validate_every = {o.validate_every}", o.validate_every >= 1, "at least 1"),
        (f"optim.learning_rate = {o.learning_rate}", 0 < o.learning_rate < math.inf, "above 0"),
        (f"optim.weight_decay = {o.weight_decay}", 0 <= o.weight_decay < math.inf, "0 or more"),
        (
            f"optim.milestones = {o.milestones}",
            all(a < b for a, b in itertools.pairwise((0, *o.milestones))),
            "epochs above 0, each later than the one before",
        ),
        (f"optim.decay = {o.decay}", 0 < o.decay <= 1, "a factor in (0, 1]"),
        (f"optim.clip_norm = {o.clip_norm}", o.clip_norm >= 0, "0 (off) or a norm"),
        (f"compute.rows = {c.compute.rows}", c.compute.rows >= 0, "0 (whole) or a chunk size"),
    ]


def is_inside(name: str) -> bool:
    """Whether a name is that of a folder below another one: relative, not empty, without `..`."""
    path = Path(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts


def _positive(widths: tuple[int, ...]) -> bool:
    return len(widths) > 0 and min(widths) > 0


def to_json(config: Config) -> str:
    """Write a config as indented JSON."""
    return json.dumps(dataclasses.asdict(config), indent=2) + "\n"


def from_json(text: str) -> Config:
    """Read what `to_json` wrote.

    Raises:
        ValueError: not JSON, an unknown flag, or a value outside its choices; the message names the flag. A flag that is missing, since
            it is younger than the file, has its default, which is what was done before there was the flag.
    """
    try:
        values = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"config: expected JSON ({error})") from error
    return _build(Config, values, "config")


def _build(kind: type, values: Any, where: str) -> Any:
    if not isinstance(values, Mapping):
        raise ValueError(f"{where} = {values!r}: expected an object of flags")
    hints = get_type_hints(kind)
    if unknown := sorted(set(values) - set(hints)):
        raise ValueError(f"{where}: unknown flags {unknown}: this config is of another version")
    return kind(**{name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()})


def _value(hint: Any, value: Any, where: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, where)  # type: ignore[arg-type]
    if get_args(hint) and all(isinstance(choice, str) for choice in get_args(hint)):
        if value not in get_args(hint):
            raise ValueError(f"{where} = {value!r}: expected one of {', '.join(get_args(hint))}")
        return value
    if get_origin(hint) is tuple:
        kinds = get_args(hint)
        if not isinstance(value, list) or (kinds[-1] is not ... and len(value) != len(kinds)):
            items = "names" if kinds[0] is str else "numbers"
            raise ValueError(f"{where} = {value!r}: expected a list of {'' if kinds[-1] is ... else f'{len(kinds)} '}{items}")
        return tuple(_value(kinds[0], item, f"{where}[{i}]") for i, item in enumerate(value))
    allowed = get_args(hint) or (hint,)
    if float in allowed and type(value) is int:
        return float(value)
    if type(value) not in allowed:
        expected = " or ".join("null" if kind is type(None) else kind.__name__ for kind in allowed)
        raise ValueError(f"{where} = {value!r}: expected {expected}")
    return value
