"""Stage by stage: every part of the Flax network alone, fed what the reference computed before it.

In float32 one changed neighbour or argmax changes everything after it, so a comparison from end to end says little. Here each
part reads the reference's float64 results, rounded; in training mode each also gets the reference's derivative of the loss by its
outputs, and so gives its share of the gradient. Choices (graphs, keypoints, correspondences) are taken from the reference.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from jax import Array

from cmig_jax import losses
from cmig_jax.config import Config
from cmig_jax.geometry.procrustes import weighted_procrustes
from cmig_jax.nn.build import build
from cmig_jax.nn.cmignet import MATCH_LIMIT, CMIGNet, credible_half
from cmig_jax.nn.edgeconv import EdgeConv
from cmig_jax.nn.mlp import Dense
from cmig_jax.nn.norm import BatchNorm
from cmig_jax.parity.flax_run import Dtype, Variables, make_batch, term_names
from cmig_jax.parity.recorded import Inputs, Run
from cmig_jax.parity.sizes import sizes_of
from cmig_jax.parity.stage_reference import Reference, channels_last
from cmig_jax.parity.weights import by_torch_name
from cmig_jax.structs import RigidTransform


def run_stages(config: Config, variables: Variables, inputs: Inputs, run: Run, train: bool, dtype: Dtype = "float32") -> Run:
    """Run every stage on the reference's results.

    Args:
        config: the released network's flags, for any sizes.
        variables: its `params` and `batch_stats`.
        inputs: the pairs; training needs `src_idx`.
        run: the reference's run in float64 on these inputs, in the same mode.
        train: training mode.
        dtype: what to compute in.
    """
    with jax.enable_x64(dtype == "float64"):
        reference = Reference(config, make_batch(inputs, dtype), inputs, run)
        parts = _Parts(jax.tree.map(lambda x: jnp.asarray(x, dtype), dict(variables)), train)
        network = build(config)
        outputs = _point_encoder(parts, config, reference)
        outputs |= _image_encoder(parts, network, reference)
        outputs |= _fusion(parts, network, reference)
        outputs |= _scores(parts, network, reference)
        terms = _encoder_losses(config, reference) if train else {}
        for i in range(config.model.matching.iterations):
            matched, new_terms = _matching(parts, network, config, reference, i)
            outputs |= matched | _pose(config, reference, i)
            terms |= new_terms
        outputs |= _whole_pose(reference)
        return _result(parts, config, outputs, terms)


class _Parts:
    """Runs modules alone; collects their gradients and new statistics under the paths that they have in the network."""

    def __init__(self, variables: Variables, train: bool) -> None:
        self.train = train
        self._variables = {kind: traverse_util.flatten_dict(variables[kind]) for kind in ("params", "batch_stats")}
        self.gradients: dict[tuple[str, ...], Any] = {}
        self.statistics: dict[tuple[str, ...], Any] = {}

    def run(self, paths: tuple[str, ...], call: Callable[..., Any], inputs: tuple[Any, ...], cotangent: Any) -> tuple[Any, Any]:
        """Run `call(variables, *inputs) -> (outputs, (new statistics, other results))`.

        Args:
            paths: of the modules, as in `points/last`; `call` gets variables cut to them, relative to their common parent if there
                are several.
            call: what to run.
            inputs: arrays.
            cotangent: of the outputs; not read in evaluation mode.

        Returns:
            the outputs and the other results.
        """
        depth = len(paths[0].split("/")) - (len(paths) > 1)
        own = [{path: x for path, x in self._variables[kind].items() if _below(path, paths)} for kind in ("params", "batch_stats")]
        params, stats = (traverse_util.unflatten_dict({path[depth:]: x for path, x in flat.items()}) for flat in own)

        if not self.train:
            output, (_, others) = _forward(call, params, stats, inputs)
            return output, others
        output, (new, others), gradients = _forward_and_back(call, params, stats, inputs, cotangent)
        parent = tuple(paths[0].split("/")[:depth])
        for path, gradient in traverse_util.flatten_dict(gradients).items():
            self.gradients[parent + path] = self.gradients.get(parent + path, 0) + gradient  # tied weights add up
        self.statistics |= {parent + path: value for path, value in traverse_util.flatten_dict(new).items()}
        return output, others


@functools.partial(jax.jit, static_argnums=0)
def _forward(call: Callable[..., Any], params: Any, stats: Any, inputs: tuple[Any, ...]) -> Any:
    return call({"params": params, "batch_stats": stats}, *inputs)


@functools.partial(jax.jit, static_argnums=0)
def _forward_and_back(call: Callable[..., Any], params: Any, stats: Any, inputs: tuple[Any, ...], cotangent: Any) -> Any:
    output, pull, rest = jax.vjp(lambda p: call({"params": p, "batch_stats": stats}, *inputs), params, has_aux=True)
    return output, rest, pull(cotangent)[0]


def _below(path: tuple[str, ...], modules: tuple[str, ...]) -> bool:
    return any("/".join(path).startswith(f"{module}/") for module in modules)


def _point_encoder(parts: _Parts, config: Config, reference: Reference) -> dict[str, Array]:
    """Each edge layer on the layers before it and their graph, the last layer on all of them."""
    widths, dim = config.model.points.widths, config.model.points.dim
    outputs: dict[str, Array] = {}
    linked = [jnp.concatenate([reference.batch.source, reference.batch.target])]
    for i, width in enumerate(widths):

        def edge(variables: Variables, x: Array, graph: Array, width: int = width) -> Any:
            (y,), new = EdgeConv(width).apply(variables, (x,), (graph,), train=parts.train, mutable=["batch_stats"])
            return y, (new["batch_stats"], None)

        name, inputs = f"layer_{i}", (jnp.concatenate(linked, axis=-1), reference.graph(i))
        outputs[name], _ = parts.run((f"points/edge_{i}",), edge, inputs, parts.train and reference.cotangent(name))
        linked.append(reference[name])

    def last(variables: Variables, x: Array) -> Any:
        y = Dense(dim, use_bias=False).apply({"params": variables["params"]["last"]}, x)
        norm = {kind: variables[kind]["last_norm"] for kind in ("params", "batch_stats")}
        y, new = BatchNorm(dim).apply(norm, y, train=parts.train, mutable=["batch_stats"])
        return jnp.split(nn.relu(y), 2), ({"last_norm": new["batch_stats"]}, None)

    names = ("feat_src", "feat_tgt")
    cotangent = parts.train and [reference.cotangent(name) for name in names]
    features, _ = parts.run(("points/last", "points/last_norm"), last, (jnp.concatenate(linked, axis=-1),), cotangent)
    outputs["feat_src"], outputs["feat_tgt"] = features
    return outputs


def _image_encoder(parts: _Parts, network: CMIGNet, reference: Reference) -> dict[str, Array]:
    """The views to one vector per pair."""

    def call(variables: Variables, views: Array) -> Any:
        assert network.views is not None
        tokens, new = network.views.apply(variables, views, train=parts.train, mutable=["batch_stats"])
        return jnp.max(tokens[:, 0], axis=1), (new["batch_stats"], None)

    cotangent = parts.train and reference.cotangent("feat_views")
    return {"feat_views": parts.run(("views",), call, (reference.batch.views,), cotangent)[0]}


def _fusion(parts: _Parts, network: CMIGNet, reference: Reference) -> dict[str, Array]:
    """The transformer's four passes."""

    def call(variables: Variables, query: Array, memory: Array) -> Any:
        assert network.transformer is not None
        return network.transformer.apply(variables, query, memory), ({}, None)

    source, target, image = reference["feat_src"], reference["feat_tgt"], reference["feat_views"][:, None]
    passes = {"attn_points_0": (source, target), "attn_points_1": (target, source)}
    passes["attn_src_views_0"] = (source + reference["attn_points_0"], image)
    passes["attn_tgt_views_0"] = (target + reference["attn_points_1"], image)
    return {name: parts.run(("transformer",), call, pair, parts.train and reference.cotangent(name))[0] for name, pair in passes.items()}


def _scores(parts: _Parts, network: CMIGNet, reference: Reference) -> dict[str, Array]:
    """The significance scores, named for the cloud whose points they pick: computed on the other one's."""

    def call(variables: Variables, points: Array, other: Array) -> Any:
        assert network.score is not None
        return network.score.apply(variables, points, jnp.max(other, axis=1)), ({}, None)

    source, target = reference.prediction.source_fused, reference.prediction.target_fused
    pairs = {"score_a": (target, source), "score_b": (source, target)}
    return {name: parts.run(("score",), call, pair, parts.train and reference.cotangent(name))[0] for name, pair in pairs.items()}


def _matching(parts: _Parts, network: CMIGNet, config: Config, reference: Reference, i: int) -> tuple[dict[str, Array], dict[str, Array]]:
    """A head, and the losses that read it."""
    given, pose = reference.prediction.iterations[i], reference.batch.target_from_source
    assert pose is not None

    def call(variables: Variables, source: Any, target: Any) -> Any:
        match, new = network.heads[i].apply(variables, source, target, train=parts.train, mutable=["batch_stats"])
        found = replace(given, match=jnp.clip(match.feature + match.coordinate, -MATCH_LIMIT, MATCH_LIMIT), logit=match.logit)
        whole, terms = replace(reference.prediction, iterations=(found,)), {}
        if parts.train:
            terms = {"mask": losses.mask(whole)} if i == 0 else {}
            terms[f"matching_{i}"] = losses.matching(whole, found, config.loss)
            terms[f"credibility_{i}"] = losses.credibility(whole, found, reference.batch.source, pose, config.loss)
        return sum(terms.values(), jnp.zeros(())), (new["batch_stats"], (match, terms))

    inputs = (replace(reference.source, points=given.source), reference.target)
    _, (match, terms) = parts.run((f"heads_{i}",), call, inputs, jnp.ones(()))
    return {f"it{i}/match_F": match.feature, f"it{i}/match_S": match.coordinate, f"it{i}/logit": match.logit}, terms


def _pose(config: Config, reference: Reference, i: int) -> dict[str, Array]:
    """Keypoints moved by the step before, correspondences and weights of the matching, the step of these."""
    match, src, corr, weight, logit = (reference[f"it{i}/{name}"] for name in ("match", "svd_src", "svd_corr", "svd_w", "logit"))
    chosen = jnp.take_along_axis(reference.target.points, jnp.argmax(match, axis=-1)[..., None], axis=1)
    step = weighted_procrustes(src, corr, weight, config.model.pose.centroid)
    before = reference.prediction.iterations[i - 1]
    moved = before.step.apply(before.source) if i > 0 else reference.source.points
    weight = credible_half(nn.sigmoid(logit))
    found = {"svd_src": moved, "svd_corr": chosen, "svd_w": weight, "R": step.R, "t": step.t}
    return {f"it{i}/{name}": value for name, value in found.items()}


def _whole_pose(reference: Reference) -> dict[str, Array]:
    """The steps, composed."""
    pose = RigidTransform.identity((reference.batch.source.shape[0],), reference.batch.source.dtype)
    for iteration in reference.prediction.iterations:
        pose = iteration.step.compose(pose)
    return {"R": pose.R, "t": pose.t}


def _encoder_losses(config: Config, reference: Reference) -> dict[str, Array]:
    """The losses on the encoders' outputs."""
    return losses.losses(replace(reference.prediction, source_scores=None, iterations=()), reference.batch, config.loss)


def _result(parts: _Parts, config: Config, outputs: dict[str, Array], terms: dict[str, Array]) -> Run:
    named = {name: channels_last(name, np.asarray(value)) for name, value in outputs.items()}
    if parts.train:
        named["loss_terms"] = np.array([terms.get(name, 0.0) for name in term_names(config)])
        named["loss"] = np.asarray(named["loss_terms"].sum())
    sizes = sizes_of(config.model)
    gradients, statistics = (traverse_util.unflatten_dict(flat) for flat in (parts.gradients, parts.statistics))
    return Run(named, by_torch_name({"params": gradients}, sizes), by_torch_name({"batch_stats": statistics}, sizes))
