"""RPM-Net (Yew and Lee, CVPR 2020): features of oriented points, a soft matching by Sinkhorn's normalisation, a pose; repeated.

Equation and section numbers refer to that paper. Every iteration starts from the original source, so its pose is absolute; the network
sees the source moved by the iteration before.
"""

from __future__ import annotations

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.config import ComputeConfig
from cmig_jax.geometry.distances import length, squared_distances
from cmig_jax.geometry.point_pairs import point_pair_features
from cmig_jax.geometry.sinkhorn import log_sinkhorn
from cmig_jax.models.base import Model
from cmig_jax.models.rpmnet.flags import GROUPS, WIDE_GROUPS, RPMNetFlags
from cmig_jax.nn.folded_norm import FoldedMLP
from cmig_jax.nn.mlp import Dense, NormedMLP
from cmig_jax.nn.recompute import call
from cmig_jax.ops.edges import gather
from cmig_jax.ops.kernels import is_fast
from cmig_jax.ops.neighbours import within_radius
from cmig_jax.ops.pooling import maximum
from cmig_jax.ops.procrustes import weighted_procrustes
from cmig_jax.structs import Batch, Correspondences, Prediction
from cmig_jax.transform import RigidTransform

HIGHEST = jax.lax.Precision.HIGHEST
EPSILON = 1e-5  # added to the sums of weights that something is divided by


@struct.dataclass
class Neighbourhoods:
    """The neighbours of each point of a cloud.

    Attributes:
        index: `[B, N, k]`.
        offset: `[B, N, k, 3]` from the point to its neighbour.
        pair: `[B, N, k, 4]` point-pair features, which no motion of the cloud changes.
    """

    index: Array
    offset: Array
    pair: Array


@struct.dataclass
class Iteration:
    """One matching.

    Attributes:
        source: `[B, N, 3]` the source as this iteration saw it.
        beta, alpha: `[B]` sharpness of the matching, and the squared distance of features below which points attract.
        affinity: `[B, N, M]` log of the scores before the normalisation (Eq. 4).
        match: `[B, N, M]` the matching; rows and columns sum to 1 at most.
        partner: `[B, N, 3]` the target's points averaged by the rows.
        pose: `[B]` from the original source to the target.
    """

    source: Array
    beta: Array
    alpha: Array
    affinity: Array
    match: Array
    partner: Array
    pose: RigidTransform


@struct.dataclass(kw_only=True)
class RPMNetPrediction(Prediction):
    """What the network returns; `iterations` are the matchings in order."""

    iterations: tuple[Iteration, ...]


class RPMNet(nn.Module):
    """Registers the source onto the target (Fig. 2)."""

    flags: RPMNetFlags
    compute: ComputeConfig = ComputeConfig()

    def setup(self) -> None:
        self.features = LocalFeatures(self.flags.dim, self.compute)
        self.parameters = ParameterNet(self.flags.parameter_widths, self.flags.parameter_head, self.compute)

    def __call__(self, batch: Batch, *, train: bool, key: Array | None = None) -> RPMNetPrediction:
        """Predict the pose of each pair; nothing is drawn, so `key` is not used.

        Raises:
            ValueError: a cloud without normals.
        """
        if batch.source_normals is None or batch.target_normals is None:
            raise ValueError("RPM-Net reads unit normals: expected batch.source_normals and batch.target_normals, got None")
        source = self.neighbourhoods(batch.source, batch.source_normals)
        target = self.neighbourhoods(batch.target, batch.target_normals)
        target_features = self.encode(batch.target, target)
        iterations, pose = [], RigidTransform.identity(batch.source.shape[:1], batch.source.dtype)
        for _ in range(self.flags.iterations if train else self.flags.test_iterations):
            # Neighbours and angles move with the cloud: only coordinates and offsets change.
            moved = pose.apply(batch.source)
            offset = jnp.einsum("bij,bnkj->bnki", pose.R, source.offset, precision=HIGHEST)
            source_features = self.encode(moved, replace(source, offset=offset))
            beta, alpha = self.parameters(moved, batch.target)
            iterations.append(self.match(batch, moved, source_features, target_features, beta, alpha))
            pose = jax.lax.stop_gradient(iterations[-1].pose)
        return _prediction(tuple(iterations))

    def neighbourhoods(self, points: Array, normals: Array) -> Neighbourhoods:
        """Find the neighbours of each point within the radius, and how they lie (Sec. 5.1)."""
        index = within_radius(points, self.flags.radius, self.flags.neighbours, self.flags.neighbours_by, self.compute)
        offset = gather(points, index) - points[:, :, None]
        own = jnp.broadcast_to(normals[:, :, None], offset.shape)
        return Neighbourhoods(index=index, offset=offset, pair=point_pair_features(offset, own, gather(normals, index)))

    def encode(self, points: Array, around: Neighbourhoods) -> Array:
        """Return features `[B, N, dim]` of length 1."""
        return call(self.features, points, around.offset, around.pair, recompute=self.compute.recompute)

    def match(self, batch: Batch, moved: Array, source: Array, target: Array, beta: Array, alpha: Array) -> Iteration:
        """Match features `source [B, N, C]`, `target [B, M, C]` and solve for the pose (Eq. 4 to 8)."""
        affinity = -beta[:, None, None] * (squared_distances(source, target) - alpha[:, None, None])
        match = jnp.exp(log_sinkhorn(affinity, self.flags.sinkhorn_rounds))
        partner = jnp.matmul(match, batch.target, precision=HIGHEST) / (jnp.sum(match, axis=-1)[..., None] + EPSILON)
        pose = weighted_procrustes(batch.source, partner, weights(match), kernels=self.compute.kernels)
        return Iteration(source=moved, beta=beta, alpha=alpha, affinity=affinity, match=match, partner=partner, pose=pose)


class LocalFeatures(nn.Module):
    """Features of points from their neighbourhoods: shared layers, the maximum over neighbours, more layers (Sec. 5.1)."""

    dim: int
    compute: ComputeConfig

    @nn.compact
    def __call__(self, points: Array, offset: Array, pair: Array) -> Array:
        """Encode `points [B, N, 3]` with `offset [B, N, k, 3]` and `pair [B, N, k, 4]` to `[B, N, dim]` of length 1."""
        options = {"compute": self.compute, "use_bias": True, "norm": "group", "groups": GROUPS}
        centre = jnp.broadcast_to(points[:, :, None], offset.shape)
        edges = jnp.concatenate([centre, offset, pair], axis=-1)
        widths = (self.dim, self.dim, 2 * self.dim)
        if is_fast(self.compute.kernels):
            pooled = FoldedMLP(widths, GROUPS, self.compute, name="edges")(edges)
        else:
            pooled = maximum(NormedMLP(widths, **options, name="edges")(edges, train=False), 2, "plain")
        hidden = NormedMLP((2 * self.dim, self.dim), **options, name="pooled")(pooled, train=False)
        feature = Dense(self.dim, compute=self.compute, name="last")(hidden).astype(points.dtype)
        norm = length(feature)
        return feature / jnp.where(norm == 0, 1, norm)[..., None]


class ParameterNet(nn.Module):
    """The annealing parameters of the matching, from both clouds together (Sec. 5.3)."""

    widths: tuple[int, ...]
    head: tuple[int, ...]
    compute: ComputeConfig

    def setup(self) -> None:
        options = {"compute": self.compute, "use_bias": True, "norm": "group"}
        self.points = NormedMLP(self.widths, **options, groups=(GROUPS,) * (len(self.widths) - 1) + (WIDE_GROUPS,))
        self.pooled = NormedMLP(self.head, **options, groups=WIDE_GROUPS)
        self.last = Dense(2, compute=self.compute)

    def __call__(self, source: Array, target: Array) -> tuple[Array, Array]:
        """Return beta and alpha `[B]` of clouds `[B, N, 3]` and `[B, M, 3]`."""
        beta, alpha = jnp.moveaxis(jax.nn.softplus(self.raw(self.pool(source, target)).astype(source.dtype)), -1, 0)
        return beta, alpha

    def pool(self, source: Array, target: Array) -> Array:
        """Encode the points of both clouds, marked by a fourth coordinate, to their maximum `[B, C]`."""
        marked = [jnp.pad(x, ((0, 0), (0, 0), (0, 1)), constant_values=mark) for mark, x in enumerate((source, target))]
        return maximum(self.points(jnp.concatenate(marked, axis=1), train=False), 1, self.compute.kernels)

    def raw(self, pooled: Array) -> Array:
        """Map `[B, C]` to the two parameters before softplus, `[B, 2]`."""
        return self.last(self.pooled(pooled, train=False))


def weights(match: Array) -> Array:
    """Return the weights `[B, N]` of the source's points in the pose: the share of each row in a matching `[B, N, M]`."""
    rows = jnp.sum(match, axis=-1)
    return rows / (jnp.sum(rows, axis=-1, keepdims=True) + EPSILON)


def _prediction(iterations: tuple[Iteration, ...]) -> RPMNetPrediction:
    last = iterations[-1].match
    source, target = (jnp.broadcast_to(jnp.arange(n), (len(last), n)) for n in last.shape[1:])
    return RPMNetPrediction(
        target_from_source=iterations[-1].pose,
        correspondences=Correspondences(source, target, jnp.argmax(last, axis=-1), weights(last)),
        source_overlap=jnp.clip(jnp.sum(last, axis=-1), 0, 1),
        target_overlap=jnp.clip(jnp.sum(last, axis=-2), 0, 1),
        iterations=iterations,
    )


def losses(prediction: RPMNetPrediction, batch: Batch, flags: RPMNetFlags, compute: ComputeConfig) -> dict[str, Array]:
    """Return for each iteration `mae_<i>`, how far it moves the source wrongly (Eq. 10), and `outlier_<i>` (Eq. 11), discounted (Eq. 12).

    The discount applies to both, as in the official code.
    """
    assert batch.target_from_source is not None
    goal, terms = batch.target_from_source.apply(batch.source), {}
    for i, iteration in enumerate(prediction.iterations):
        factor = flags.discount ** (len(prediction.iterations) - 1 - i)
        unmatched = sum(jnp.mean(1 - jnp.sum(iteration.match, axis=axis)) for axis in (-2, -1))
        terms[f"mae_{i}"] = factor * jnp.mean(jnp.abs(iteration.pose.apply(batch.source) - goal))
        terms[f"outlier_{i}"] = factor * flags.outlier_weight * unmatched
    return terms


RPMNET = Model(flags=RPMNetFlags, build=RPMNet, losses=losses)
