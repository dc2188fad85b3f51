"""CMIGNet's flags, whose defaults are the paper's settings, and the values of its presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

from cmig_jax.config import ModelFlags, Needs, check

LOCAL_GROUPS = 8
"""Groups of the normalisation of local features."""


@dataclass(frozen=True)
class PointsFlags:
    """Point encoder: densely linked EdgeConv layers (Sec. III-A)."""

    k: int = 20
    """Neighbours in the graph, the point itself included."""
    widths: tuple[int, ...] = (64, 64, 64, 128)
    """Channels of the EdgeConv layers."""
    dim: int = 512
    """Channels C of the point features."""
    local: Literal["none", "pairs"] = "none"
    """What the encoder reads beside coordinates; `pairs`: features of a point's pairs with its neighbours, from normals, that no turn
    changes (not in the paper; after RPM-Net)."""
    local_widths: tuple[int, ...] = (32, 32)
    """Channels of the layers of `local=pairs`, multiples of 8."""


@dataclass(frozen=True)
class ImageFlags:
    """Image encoder: ResNet, maximum over views (Eq. 1)."""

    widths: tuple[int, ...] = (64, 128, 256, 512)
    """Channels of the stages; the last must equal `points.dim`, since the two modalities share one space (Eq. 3)."""
    blocks: tuple[int, ...] = (2, 2, 2, 2)
    """Basic blocks per stage; (2, 2, 2, 2) is ResNet-18."""


@dataclass(frozen=True)
class FusionFlags:
    """Transformer fusion (Sec. III-C; TF and CMD of Table 6)."""

    points: Literal["transformer", "none"] = "transformer"
    """First layer, between the two clouds (TF)."""
    image: Literal["cross-attention", "transformer", "views", "none"] = "cross-attention"
    """Second layer, from points to image (CMD): Eq. 8; the first layer's weights again; Eq. 8 with one token per view; or none."""
    heads: int = 4
    """Attention heads of the transformer."""
    feed_forward: int = 1024
    """Hidden channels of its feed-forward layers."""


@dataclass(frozen=True)
class KeypointsFlags:
    """Mask prediction (Sec. III-D; MP of Table 6)."""

    select: Literal["predicted", "random", "all"] = "predicted"
    """Keypoints: the points of the highest scores (in training drawn at random, so that the scores are learned), random points, or all
    points. A network trained without scores has none to select by."""
    count: int = 256
    """Keypoints K per cloud."""
    test_count: int = 0
    """Keypoints K in evaluation, at most all points; 0: as in training."""
    score_from: Literal["own", "other"] = "own"
    """Whose point features score a cloud's points; `other` (the released network) needs clouds of equal size."""
    activation: Literal["linear", "sigmoid"] = "linear"
    """Last activation of the score; its target is a negative entropy, at most 0, which a sigmoid cannot reach."""
    target: Literal["entropy", "overlap"] = "entropy"
    """What a score learns: the negative entropy of the point's matching, or the logit that the point has a partner, which then weighs its
    correspondence too (not in the paper)."""


@dataclass(frozen=True)
class MatchingFlags:
    """Correspondence search (Sec. III-E, Tables 7 and 8)."""

    head: Literal["cmignet", "idam", "pcrnet"] = "cmignet"
    """Similarities from features and coordinates separately (the paper's), from both together (IDAM), or a regressed pose (PCRNet)."""
    iterations: int = 3
    """Iterations n, each with its own weights."""
    repeats: int = 0
    """Further iterations in evaluation, with the weights of the last; 0 is the paper's."""
    correspondence: Literal["hard", "soft", "sinkhorn"] = "hard"
    """Correspondent of a source keypoint: the best target keypoint, the mean of all under the softmax of the matching, or under Sinkhorn's
    normalisation with slack, whose rows then weigh the correspondences too (not in the paper; RPM-Net's)."""
    features: Literal["once", "anew"] = "once"
    """`anew`: each of the n iterations encodes the source as the ones before have moved it, and further `repeats` keep the last features
    (not in the paper; PRNet's). In training the running statistics see every encoding."""
    feature_widths: tuple[int, ...] = (256, 128, 64, 32, 32, 32)
    """Channels of the feature similarity network."""
    coordinate_widths: tuple[int, ...] = (32, 32, 32)
    """Channels of the coordinate similarity network."""


@dataclass(frozen=True)
class PoseFlags:
    """Weighted SVD (Eq. 11)."""

    centroid: Literal["weighted", "unweighted"] = "weighted"
    """Centroids in the covariance: weighted ones minimise Eq. 11, unweighted ones are the released network's."""
    gradient: Literal["stopped", "through"] = "stopped"
    """Whether the pose carries a gradient into the next iteration."""


@dataclass(frozen=True)
class LossFlags:
    """The five losses (Sec. III-B and III-F)."""

    overlap: bool = True
    """Overlapping contrastive loss (Eq. 2)."""
    overlap_mean: Literal["all", "active"] = "all"
    """Eq. 2 divides by all pairs; the released network by those with a non-zero term."""
    margins: tuple[float, float] = (70.0, 3.0)
    """Margins of Eq. 2: positive, negative; feature distance."""
    overlap_threshold: float = 0.01
    """A point overlaps if the other cloud has a point closer than this under the true pose, object units."""
    match_threshold: float = 0.05
    """Two keypoints correspond if they are closer than this under the true pose, object units; so do a point and its partner in
    `keypoints.target=overlap`."""
    cross_modal: Literal["paper", "nt-xent", "off"] = "paper"
    """Cross-modal contrastive loss: Eq. 6 (no positive in the denominator), NT-Xent (with it), or none."""
    temperature: float = 0.1
    """Temperature of the cross-modal loss (Eq. 4)."""
    credibility_label: Literal["distance", "index"] = "distance"
    """Label of the matching score: correspondent closer than `match_threshold`, or with the same index."""
    match_mean: Literal["all", "positive"] = "all"
    """Correspondence loss averaged over all K, or over those with a true correspondent; with Sinkhorn's matching, over all."""


@dataclass(frozen=True)
class CMIGNetFlags(ModelFlags):
    """The network (Fig. 2) and its losses."""

    network: ClassVar[str] = "cmignet"
    title: ClassVar[str] = "CMIGNet"

    points: PointsFlags = field(default_factory=PointsFlags)
    image: ImageFlags = field(default_factory=ImageFlags)
    fusion: FusionFlags = field(default_factory=FusionFlags)
    keypoints: KeypointsFlags = field(default_factory=KeypointsFlags)
    matching: MatchingFlags = field(default_factory=MatchingFlags)
    pose: PoseFlags = field(default_factory=PoseFlags)
    loss: LossFlags = field(default_factory=LossFlags)

    def __post_init__(self) -> None:
        check((f"model.{name}", valid, expected) for name, valid, expected in self._rules())

    @property
    def needs(self) -> Needs:
        """Neighbours, keypoints, images for a layer or a loss, and several pairs for the cross-modal loss."""
        chosen = self.keypoints.select != "all"
        return Needs(
            points=max(self.points.k, self.keypoints.count if chosen and not self.keypoints.test_count else 3),
            training_points=max(self.points.k, self.keypoints.count if chosen else 3),
            pairs=1 if self.loss.cross_modal == "off" else 2,
            views=self.fusion.image != "none" or self.loss.cross_modal != "off",
            equal_sizes=self.keypoints.select == "predicted" and self.keypoints.score_from == "other",
            normals=self.points.local == "pairs",
        )

    def _rules(self) -> list[tuple[str, bool, str]]:
        points, image, fusion, matching, loss = self.points, self.image, self.fusion, self.matching, self.loss
        return [
            (f"points.k = {points.k}", points.k >= 1, "at least 1"),
            (f"points.widths = {points.widths}", _positive(points.widths), "one or more numbers above 0"),
            (f"points.dim = {points.dim}", points.dim >= 4, "at least 4"),
            (
                f"points.local_widths = {points.local_widths}",
                _positive(points.local_widths) and not any(width % LOCAL_GROUPS for width in points.local_widths),
                f"one or more multiples of {LOCAL_GROUPS}",
            ),
            (
                f"image.widths = {image.widths}",
                _positive(image.widths) and (not self.needs.views or image.widths[-1] == points.dim),
                f"the last one to equal model.points.dim = {points.dim}",
            ),
            (
                f"image.blocks = {image.blocks}",
                len(image.blocks) == len(image.widths),
                f"{len(image.widths)} numbers, one for each of model.image.widths",
            ),
            (
                f"fusion.heads = {fusion.heads}",
                fusion.heads >= 1 and points.dim % fusion.heads == 0,
                f"a divisor of model.points.dim = {points.dim}",
            ),
            (
                "fusion.image = transformer with model.fusion.points = none",
                not (fusion.image == "transformer" and fusion.points == "none"),
                "model.fusion.points = transformer, whose weights it shares",
            ),
            (f"fusion.feed_forward = {fusion.feed_forward}", fusion.feed_forward >= 1, "at least 1"),
            *(
                (
                    f"{flag} = {value} with model.keypoints.target = overlap",
                    self.keypoints.target == "entropy" or value == expected,
                    f"{expected}",
                )
                for flag, value, expected in (
                    ("keypoints.select", self.keypoints.select, "predicted"),
                    ("keypoints.activation", self.keypoints.activation, "linear"),
                    ("keypoints.score_from", self.keypoints.score_from, "own"),
                )
            ),
            (
                f"matching.head = pcrnet with model.keypoints.target = {self.keypoints.target}, correspondence = {matching.correspondence}",
                matching.head != "pcrnet" or (self.keypoints.target, matching.correspondence) in (("entropy", "hard"), ("entropy", "soft")),
                "another head: this one matches no keypoints",
            ),
            (f"keypoints.count = {self.keypoints.count}", self.keypoints.count >= 2, "at least 2"),
            (
                f"keypoints.test_count = {self.keypoints.test_count}",
                self.keypoints.test_count == 0 or self.keypoints.test_count >= 2,
                "0 (as in training), or at least 2",
            ),
            (f"matching.feature_widths = {matching.feature_widths}", _positive(matching.feature_widths), "one or more numbers above 0"),
            (
                f"matching.coordinate_widths = {matching.coordinate_widths}",
                _positive(matching.coordinate_widths),
                "one or more numbers above 0",
            ),
            (f"matching.iterations = {matching.iterations}", matching.iterations >= 1, "at least 1"),
            (f"matching.repeats = {matching.repeats}", matching.repeats >= 0, "0 (none) or more"),
            (f"loss.overlap_threshold = {loss.overlap_threshold}", loss.overlap_threshold > 0, "above 0"),
            (f"loss.match_threshold = {loss.match_threshold}", loss.match_threshold > 0, "above 0"),
            (f"loss.margins = {loss.margins}", min(loss.margins) >= 0, "two distances, 0 or more"),
            (f"loss.temperature = {loss.temperature}", loss.temperature > 0, "above 0"),
        ]


def _positive(widths: tuple[int, ...]) -> bool:
    return len(widths) > 0 and min(widths) > 0


def paper() -> CMIGNetFlags:
    """Return the paper's settings; where the paper is silent, the released network's."""
    return CMIGNetFlags()


def released() -> CMIGNetFlags:
    """Return the settings of the released PyTorch network."""
    return CMIGNetFlags(
        fusion=FusionFlags(image="transformer"),
        keypoints=KeypointsFlags(score_from="other", activation="sigmoid"),
        pose=PoseFlags(centroid="unweighted"),
        loss=LossFlags(overlap=False, overlap_mean="active", cross_modal="nt-xent", credibility_label="index", match_mean="positive"),
    )


def corrected() -> CMIGNetFlags:
    """Return our settings (`docs/results.md`): one token per view, no predicted keypoints, soft correspondences; at test all points,
    repeated."""
    return replace(
        released(),
        fusion=FusionFlags(image="views"),
        keypoints=KeypointsFlags(select="random", test_count=768),
        matching=MatchingFlags(repeats=5, correspondence="soft"),
        pose=PoseFlags(centroid="unweighted"),
    )


def upgraded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Bring a config from before networks had names to the present layout: losses among the flags, on and off as booleans."""
    values = {name: dict(group) if isinstance(group, Mapping) else group for name, group in values.items()}
    loss, model = values.pop("loss", {}), values.get("model", {})
    for group, name in ((loss, "overlap"), (values.get("compute"), "recompute")):
        if isinstance(group, dict) and group.get(name) in ("on", "off"):
            group[name] = group[name] == "on"
    return values | {"network": CMIGNetFlags.network, "model": {**model, "loss": loss} if isinstance(model, dict) else model}
