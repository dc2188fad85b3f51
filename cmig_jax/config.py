"""The flags of a run: frozen dataclasses whose defaults are the paper's settings.

The docstring below each field gives its meaning, unit and source ("Sec.", "Eq." and "Table" refer to Xie et al., RA-L 2023); `--help`
prints it. A network's own flags stand beside the network (`models/<name>/flags.py`) and inherit from `ModelFlags`. Nothing here imports
JAX, so NumPy-only code and JAX code read the same settings.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

Categories = Literal["all", "first-half", "second-half"]
Kernels = Literal["auto", "plain", "fast"]
Sampling = Literal["once", "twice", "subsets"]
Crop = Literal["shared", "independent", "half-space", "source", "none"]
Turn = Literal["positive", "either", "any"]
Poses = Literal["euler", "twist"]
Drawn = Literal["each-pair", "each-object"]
Noise = Literal["fixed", "uniform"]
Tested = Literal["test", "validation"]
Frame = Literal["object", "any", "half"]
Normals = Literal["object", "observed"]
Layout = Literal["dodecahedron", "ring", "axes"]
Rule = tuple[str, bool, str]
"""A flag and its value, whether it is valid, and what was expected."""
LEAST_SHARE = 0.1  # that a crop of its own may leave of a cloud


class FlagError(ValueError):
    """A flag has a value that it cannot have."""


_checks = ContextVar("_checks", default=True)


@contextlib.contextmanager
def unchecked() -> Iterator[None]:
    """Accept any flags inside: for a first pass over a command line whose defaults are not known yet."""
    token = _checks.set(False)
    try:
        yield
    finally:
        _checks.reset(token)


def check(rules: Iterable[Rule]) -> None:
    """Raise FlagError for the first rule that does not hold."""
    for name, valid, expected in rules:
        if not valid and _checks.get():
            raise FlagError(f"{name}: expected {expected}")


@dataclass(frozen=True)
class DataConfig:
    """Objects and the protocol that turns an object into a pair (Sec. IV-A, IV-B)."""

    source: str = "modelnet40-hdf5"
    """Kind of data, one of `cmig_jax/data/sources`: `shapes` (generated objects), `modelnet40-hdf5`, `meshes` (a folder of meshes or clouds
    per category), `stanford` (models), `sevenscenes` (fragments); or, for evaluation only, recorded pairs with their true pose:
    `stanford-scans`, `sevenscenes-fragments`. Recorded pairs read only `root`, `prepared`, `points`, `keep`, `crop` (for the numbers of
    points), `max-angle-deg` (pairs with a larger rotation are left out) and `test-seed`."""
    root: str | None = None
    """Folder of the raw data (`shapes` needs none)."""
    prepared: str | None = None
    """Folder of the prepared data; made from `root` if it does not exist (default: a folder under data/ named after its settings)."""
    categories: Categories = "all"
    """Categories to train and validate on (labels below half of their number are the first half)."""
    test_categories: Categories = "all"
    """Categories to test on; `second-half` after training on `first-half` is the unseen-category protocol (Sec. IV-B)."""
    exclude: tuple[str, ...] = ()
    """Names of categories to leave out of training, validation and test, for example symmetric ones."""
    shapes: int = 40
    """Generated objects per category for training, with `source=shapes`; the test split has a quarter as many."""
    points: int = 1024
    """Points per object before the crop (Sec. IV-B)."""
    sampling: Sampling = "once"
    """`once`: both clouds start from the same points; `twice`: from two independent samplings with no common point; `subsets`: each from
    a random subset of the object's prepared points, so that they share some points (RPM-Net)."""
    keep: float = 0.75
    """Share of the points that the crop keeps (Sec. IV-B removes 25 %)."""
    keep_least: float = 0.0
    """Above 0, the share of each pair is drawn from [this, keep], of so many more points that as many are left as with `keep`; an object
    needs points * keep / keep_least of them (twice as many with `sampling=twice`)."""
    crop: Crop = "shared"
    """Crop around one far point for both clouds, one far point each (lower overlap), a random half-space each (RPM-Net), a far point for
    the source alone with a complete target (`source`: MaskNet), or no crop."""
    noise_std: float = 0.01
    """Standard deviation of the Gaussian noise on every coordinate, object units; 0 turns noise off (Sec. IV-B)."""
    noise: Noise = "fixed"
    """`uniform`: the standard deviation of each pair is drawn from [0, noise_std] (MaskNet)."""
    noise_clip: float = 0.05
    """Largest absolute noise, object units (Sec. IV-B)."""
    pose: Poses = "euler"
    """`euler`: rotation and translation as the next three flags say; `twist`: the exponential of a twist (w, v) of uniform direction in six
    dimensions and of uniform length in [0, max_twist], whatever those say (PointNetLK, MaskNet)."""
    max_angle_deg: float = 45.0
    """Each of the three Euler angles is uniform in [0, this], degrees (Sec. IV-B)."""
    turn: Turn = "positive"
    """`positive`: angles as above; `either`: uniform in [-max_angle_deg, max_angle_deg]; `any`: every rotation alike, whatever
    max_angle_deg."""
    max_translation: float = 0.5
    """Each translation component is uniform in [-this, this], object units (Sec. IV-B)."""
    max_twist: float = 0.8
    """Largest length of a twist with `pose=twist`: w in radians, v in object units. It is also the largest angle of rotation."""
    pose_of: Drawn = "each-pair"
    """Whose pose is drawn: that of each pair, or one pose for each object, which it keeps throughout the training (PCRNet's released
    code)."""
    frame: Frame = "object"
    """`any`: each pair is turned at random as a whole, so that objects, crops and motions have no preferred direction; `half`: half of the
    training pairs are, those of validation and test are not. In the frame of its object, which stands upright, a pair is easier."""
    normals: Normals = "object"
    """Normals of a network that reads them. `object`: of the complete object's surface, turned with it (RPM-Net): those of the faces of a
    mesh, or of the file, else estimated from the cloud. `observed`: estimated from each cropped, noisy cloud. Recorded pairs and `register`
    estimate them from the observed clouds in either case."""
    validation: float = 0.1
    """Share of the training objects held out to choose the checkpoint; the test split is never used for that."""
    tested: Tested = "test"
    """Objects that are evaluated on: those of the test file, or the training objects that `validation` holds out (with the
    training's source, categories, `validation` and `test_seed`). Whatever is chosen is chosen on the latter; a run's checkpoint was."""
    test_seed: int = 1234
    """Seed of the validation and test pairs, and of the poses with `pose_of=each-object`: a pair is a function of this seed and its
    object."""
    workers: int = 0
    """Loader processes; 0 makes pairs in threads of the training process."""

    def __post_init__(self) -> None:
        check(
            [
                (f"data.points = {self.points}", self.points >= 1, "at least 1"),
                (f"data.keep = {self.keep}", 0 < self.keep <= 1, "a share in (0, 1]"),
                (
                    f"data.keep_least = {self.keep_least}",
                    self.keep_least == 0 or LEAST_SHARE <= self.keep_least <= self.keep,
                    f"0, or a share from {LEAST_SHARE} to data.keep = {self.keep}",
                ),
                (
                    f"data.keep_least = {self.keep_least} with data.crop = {self.crop}",
                    self.keep_least == 0 or self.crop in ("shared", "independent", "half-space"),
                    "a crop of both clouds",
                ),
                (f"data.points = {self.points}, data.keep = {self.keep}", self.cropped_points >= 1, "at least one point left"),
                (f"data.noise_std = {self.noise_std}", 0 <= self.noise_std < math.inf, "0 or more"),
                (f"data.noise_clip = {self.noise_clip}", self.noise_clip >= 0, "0 or more"),
                (f"data.max_translation = {self.max_translation}", 0 <= self.max_translation < math.inf, "0 or more"),
                (f"data.max_twist = {self.max_twist}", 0 <= self.max_twist < math.inf, "0 or more"),
                (f"data.test_seed = {self.test_seed}", self.test_seed >= 0, "0 or more"),
                (f"data.workers = {self.workers}", self.workers >= 0, "0 or more"),
                (f"data.max_angle_deg = {self.max_angle_deg}", 0 <= self.max_angle_deg <= 180, "degrees in [0, 180]"),
                (f"data.validation = {self.validation}", 0 < self.validation < 1, "a share in (0, 1)"),
                (f"data.shapes = {self.shapes}", self.shapes >= 4, "at least 4 per category"),
            ]
        )

    @property
    def cropped_points(self) -> int:
        """Points after the crop: of each cloud, or of the source with `crop=source`."""
        return self.points if self.crop == "none" else round(self.points * self.keep)

    @property
    def most_points(self) -> int:
        """Points per cloud before the crop, at most."""
        return math.ceil(self.cropped_points / self.keep_least) if self.keep_least else self.points

    @property
    def as_tested(self) -> DataConfig:
        """The protocol of validation and test pairs, of which `frame=half` turns none."""
        return replace(self, frame="object") if self.frame == "half" else self

    @property
    def target_points(self) -> int:
        """Points of the target after the crop."""
        return self.points if self.crop == "source" else self.cropped_points


@dataclass(frozen=True)
class ViewsConfig:
    """Depth projections (Sec. III-A)."""

    of: Literal["object", "source", "target", "both"] = "object"
    """What is rendered: the complete object in the source's frame (ahead of time), the observed source, the observed target, or both."""
    count: int = 20
    """Number of views V: 20 for `dodecahedron`, 6 for `axes`, any for `ring`."""
    size: int = 224
    """Height and width of a view, pixels."""
    layout: Layout = "dodecahedron"
    """Positions of the cameras on the unit sphere."""
    shown: Literal["real", "shuffled", "zero"] = "real"
    """Views given to the network: the pair's own, those of another object, or black ones. Tests whether the images matter."""

    def __post_init__(self) -> None:
        count = {"dodecahedron": 20, "axes": 6}.get(self.layout, self.count)
        check(
            [
                (f"views.count = {self.count}", self.count == count and count >= 1, f"{count} for views.layout={self.layout}"),
                (f"views.size = {self.size}", self.size >= 8, "at least 8 pixels"),
            ]
        )

    @property
    def sets(self) -> int:
        """View sets S per pair: one per rendered cloud."""
        return 2 if self.of == "both" else 1


@dataclass(frozen=True)
class Needs:
    """What a network requires of its input.

    Attributes:
        points: fewest points per cloud in evaluation.
        training_points: fewest points per cloud in training.
        pairs: fewest pairs per training step.
        views: whether it reads depth views.
        axis_views: whether those must be the six along the axes, of each cloud.
        equal_sizes: whether both clouds must have the same number of points.
        normals: whether it reads unit normals of the points.
    """

    points: int = 3
    training_points: int = 3
    pairs: int = 1
    views: bool = False
    axis_views: bool = False
    equal_sizes: bool = False
    normals: bool = False


@dataclass(frozen=True)
class ModelFlags:
    """Base class of the flags of a network; its subclass stands beside the network in `models/`.

    Attributes:
        network: key of the network in `models.networks.NETWORKS`.
        title: name of the network in tables and pictures.
    """

    network: ClassVar[str]
    title: ClassVar[str]

    @property
    def needs(self) -> Needs:
        """What a network with these flags requires of its input."""
        return Needs()


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its schedule (Sec. IV-A)."""

    learning_rate: float = 1e-4
    """Initial learning rate."""
    weight_decay: float = 1e-3
    """L2 term added to the gradient before Adam's moments."""
    schedule: Literal["step", "cosine"] = "step"
    """`step`: times `decay` at each of `milestones`; `cosine`: linear warm-up over the first 5 %, then cosine decay to 1 %."""
    milestones: tuple[int, ...] = (50, 75)
    """Epochs after which the learning rate is multiplied by `decay`."""
    decay: float = 0.5
    """Factor of the step schedule."""
    epochs: int = 100
    """Passes over the training objects."""
    batch: int = 6
    """Pairs per step over all devices; the last incomplete batch of an epoch is dropped."""
    clip_norm: float = 0.0
    """Largest global gradient norm; 0 turns clipping off."""
    validate_every: int = 1
    """Epochs between validations, each of which saves a checkpoint."""

    def __post_init__(self) -> None:
        increasing = all(a < b for a, b in itertools.pairwise((0, *self.milestones)))
        check(
            [
                (f"optim.epochs = {self.epochs}", self.epochs >= 1, "at least 1"),
                (f"optim.batch = {self.batch}", self.batch >= 1, "at least 1 pair"),
                (f"optim.validate_every = {self.validate_every}", self.validate_every >= 1, "at least 1"),
                (f"optim.learning_rate = {self.learning_rate}", 0 < self.learning_rate < math.inf, "above 0"),
                (f"optim.weight_decay = {self.weight_decay}", 0 <= self.weight_decay < math.inf, "0 or more"),
                (f"optim.milestones = {self.milestones}", increasing, "epochs above 0, each later than the one before"),
                (f"optim.decay = {self.decay}", 0 < self.decay <= 1, "a factor in (0, 1]"),
                (f"optim.clip_norm = {self.clip_norm}", self.clip_norm >= 0, "0 (off) or a norm"),
            ]
        )


@dataclass(frozen=True)
class ComputeConfig:
    """How the network is computed, not what it computes."""

    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the layers; geometry, normalisation statistics and losses stay in float32."""
    kernels: Kernels = "auto"
    """Implementation of the operations in `cmig_jax/ops`: `plain` uses JAX's own formulas and derivatives, `fast` uses hand-written
    derivatives and chunks; `auto` is `fast` on a CPU and `plain` elsewhere."""
    recompute: bool = False
    """In training, keep only the inputs of large blocks (for CMIGNet: image blocks, fusion passes, iterations) and recompute the rest for
    the derivative: less memory, more time."""
    rows: int = 0
    """Largest number of rows per chunk in nearest neighbours, attention and layers over pairs, which bounds memory. 0: neighbours and
    attention at once, layers over pairs in chunks that fit the cache."""

    def __post_init__(self) -> None:
        check([(f"compute.rows = {self.rows}", self.rows >= 0, "0 (no limit) or a chunk size")])

    @property
    def dtype(self) -> str | None:
        """Type that the layers compute in; None: that of their parameters."""
        return "bfloat16" if self.precision == "bfloat16" else None


@dataclass(frozen=True, kw_only=True)
class Config:
    """One run."""

    name: str
    """Name of the run folder under runs/."""
    model: ModelFlags
    """Flags of the network."""
    seed: int = 0
    """Seed of the weights, the training pairs and their order."""
    data: DataConfig = field(default_factory=DataConfig)
    views: ViewsConfig = field(default_factory=ViewsConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)

    def __post_init__(self) -> None:
        pairs, equal = self.model.needs.pairs, self.model.needs.equal_sizes
        check(
            [
                (f"name = {self.name}", is_inside(self.name), "the name of a folder under runs/"),
                (f"seed = {self.seed}", self.seed >= 0, "0 or more"),
                (f"optim.batch = {self.optim.batch}", self.optim.batch >= pairs, f"at least {pairs} pairs for this network and its losses"),
                (
                    f"data.crop = {self.data.crop}",
                    not (equal and self.data.crop == "source"),
                    "another crop, since the network needs equal sizes",
                ),
                (
                    f"views.of = {self.views.of}, views.layout = {self.views.layout}",
                    not self.model.needs.axis_views or (self.views.of, self.views.layout) == ("both", "axes"),
                    "both, and axes: the network asks where points fall in the views",
                ),
                (
                    f"data.frame = {self.data.frame} with views.of = {self.views.of}",
                    self.data.frame == "object" or self.views.of != "object" or not self.model.needs.views,
                    "views of the observed clouds: those of an object are rendered in its own frame",
                ),
            ]
        )


def views_to_prepare(config: Config) -> ViewsConfig:
    """Return the views that prepared data must hold: those of the config, or none ahead of time for a network that reads none."""
    return config.views if config.model.needs.views else replace(config.views, of="both")


def is_inside(name: str) -> bool:
    """Return whether a name is a relative path below another folder: not empty, not absolute, without `..`."""
    path = Path(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts
