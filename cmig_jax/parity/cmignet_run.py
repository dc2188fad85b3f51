"""Run CMIGNet on the inputs of a case, watch its stages, and give their results PyTorch's names and layout.

A `forced` value takes the place of what a stage computed, for the stages after it, the losses and the derivative (which still runs
through the stage). With all values forced, every stage reads given inputs, and is compared alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from cmig_jax.config import Config
from cmig_jax.models.cmignet.flags import CMIGNetFlags
from cmig_jax.models.networks import model_of
from cmig_jax.parity.cases import Arrays, State
from cmig_jax.parity.cmignet_layout import layout
from cmig_jax.parity.rows import Dtype
from cmig_jax.parity.weights import by_torch_name
from cmig_jax.structs import Batch
from cmig_jax.transform import RigidTransform

Variables = Mapping[str, Any]

INPUTS = {"src": "B 3 N", "tgt": "B 3 N", "views": "B V 3 H W", "R_gt": "B 3 3", "t_gt": "B 3", "src_idx": "B K"}
TRAINING_INPUTS = ("src_idx",)
CHANNELS_SECOND = ("feat_src", "feat_tgt", "attn_", "svd_src", "svd_corr")
PASSES = ("attn_points_0", "attn_points_1", "attn_src_views_0", "attn_tgt_views_0")
MATCHED = ("match_F", "match_S", "logit")
SOLVED = ("svd_src", "R", "t", "used_F", "used_S", "match", "used_logit", "svd_w", "chosen", "svd_corr")
STAGES: dict[str, Callable[[int], tuple[str, ...]]] = {
    "EdgeConv.__call__": lambda i: (f"layer_{i}",),
    "CMIGNet.encode": lambda _: ("feat_src", "feat_tgt"),
    "CMIGNet.view_tokens": lambda _: ("tokens",),
    "PairTransformer.__call__": lambda i: PASSES[i : i + 1],
    "CMIGNet.significance": lambda _: ("score_a", "score_b"),
    "CMIGNet._keypoints": lambda _: ("src_chosen", "tgt_chosen"),
    "CMIGNet._training_keypoints": lambda _: ("src_chosen", "tgt_chosen", "partner", "label"),
    "CMIGNetHead.__call__": lambda i: tuple(f"it{i}/{name}" for name in MATCHED),
    "CMIGNet._solve": lambda i: tuple(f"it{i}/{name}" for name in SOLVED),
}
"""Methods of the network's modules, and the names of what their call number i returns, leaf by leaf."""


class _Watch:
    """Interceptor of the stages: notes what they compute, and puts forced values in its place."""

    def __init__(self, forced: Mapping[str, Array]) -> None:
        self.seen: dict[str, Array] = {}
        self._forced, self._calls = forced, Counter[str]()

    def __call__(self, call: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any], context: Any) -> Any:
        stage = f"{type(context.module).__name__}.{context.method_name}"
        if stage not in STAGES:
            return call(*args, **kwargs)
        number = self._calls[stage]
        self._calls[stage] += 1
        if stage == "EdgeConv.__call__":  # its graph is chosen between two stages
            args = (args[0], (self._through(f"graph_{number}", args[1][0]),))
        leaves, structure = jax.tree.flatten(call(*args, **kwargs))
        return structure.unflatten(map(self._through, STAGES[stage](number), leaves))

    def _through(self, name: str, value: Array) -> Array:
        self.seen[name] = value
        if name not in self._forced:
            return value
        forced = self._forced[name].astype(value.dtype)
        return forced if jnp.issubdtype(value.dtype, jnp.integer) else forced + (value - jax.lax.stop_gradient(value))


@cache
def make_pass(config: Config, train: bool) -> Callable[..., tuple[Any, Any]]:
    """Compile a pass of the network: (variables, batch, source_index, forced) -> (gradients, (stages, terms of the loss, statistics))."""
    model = model_of(config.model)
    network = model.build(config.model, config.compute)

    def forward(params: Any, variables: Variables, batch: Batch, index: Array | None, forced: Mapping[str, Array]) -> tuple[Array, Any]:
        watch = _Watch(forced)
        with nn.intercept_methods(watch):
            given = {**variables, "params": params}
            prediction, new = network.apply(given, batch, train=train, source_index=index, mutable=["batch_stats"])
        terms = model.losses(prediction, batch, config.model, config.compute) if train else {}
        pose = prediction.target_from_source
        return sum(terms.values(), jnp.zeros(())), (watch.seen | {"R": pose.R, "t": pose.t}, terms, new["batch_stats"])

    def run(variables: Variables, batch: Batch, index: Array | None, forced: Mapping[str, Array]) -> tuple[Any, Any]:
        if not train:
            return {}, forward(variables["params"], variables, batch, index, forced)[1]
        (_, results), gradients = jax.value_and_grad(forward, has_aux=True)(variables["params"], variables, batch, index, forced)
        return gradients, results

    return jax.jit(run)


def run_flax(config: Config, variables: Variables, inputs: Arrays, dtype: Dtype, forced: State) -> Arrays:
    """Run forward and, where the inputs have `src_idx`, in training mode and backward.

    Args:
        config: the network, of the released kind.
        variables: its `params` and `batch_stats`.
        inputs: arrays of `INPUTS`.
        dtype: what to compute in.
        forced: what the stages after a result read instead of it, by its name.

    Returns:
        The results by name (`cases`): of the stages, `R`, `t`, `gradient/...`, `statistics/...`, `loss_terms` and `loss`.
    """
    flags, train = config.model, "src_idx" in inputs
    assert isinstance(flags, CMIGNetFlags)
    with jax.enable_x64(dtype == "float64"):
        cast = jax.tree.map(lambda x: jnp.asarray(x, dtype), dict(variables))
        given = {name: jnp.asarray(_swapped(name, value)) for name, value in forced.items()}
        gradients, (seen, terms, statistics) = make_pass(config, train)(cast, *make_batch(inputs, dtype), given)
        results = {name: _swapped(name, np.asarray(value)) for name, value in seen.items()}
        terms = [float(terms.get(name, 0.0)) for name in term_names(flags)]
    results["feat_views"] = results["tokens"][:, 0].max(axis=1)
    results |= {f"{name.split('/')[0]}/kept": value > 0 for name, value in results.items() if name.endswith("/svd_w")}
    if train:
        results |= {"loss_terms": np.array(terms), "loss": np.array(sum(terms))}
    trees = {"gradient": {"params": gradients}, "statistics": {"batch_stats": statistics}}
    return results | {f"{kind}/{name}": x for kind, tree in trees.items() for name, x in by_torch_name(tree, layout(flags)).items()}


def make_batch(inputs: State, dtype: Dtype) -> tuple[Batch, Array | None]:
    """Turn inputs, channels second, into what the network reads: a batch, and the training keypoints if there are any."""
    batch = Batch(
        source=jnp.asarray(inputs["src"].swapaxes(1, 2), dtype),
        target=jnp.asarray(inputs["tgt"].swapaxes(1, 2), dtype),
        views=jnp.asarray(np.moveaxis(inputs["views"], 2, -1)[:, None], dtype),
        target_from_source=RigidTransform(R=jnp.asarray(inputs["R_gt"], dtype), t=jnp.asarray(inputs["t_gt"], dtype)),
    )
    return batch, jnp.asarray(inputs["src_idx"], jnp.int32) if "src_idx" in inputs else None


def term_names(flags: CMIGNetFlags) -> list[str]:
    """Name the terms of the loss in their recorded order; a term that is off is recorded as 0."""
    names = ["cross_modal", "overlap", "mask"]
    return names + [f"{kind}_{i}" for i in range(flags.matching.iterations) for kind in ("matching", "credibility")]


def _swapped(name: str, value: NDArray) -> NDArray:
    """Swap points and channels of a result that has both, between PyTorch's order and ours (either way)."""
    return value.swapaxes(1, 2) if name.split("/")[-1].startswith(CHANNELS_SECOND) else value
