"""Run the Flax network on the inputs of a case, and give its results PyTorch names and layout."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from cmig_jax.config import Config
from cmig_jax.losses import losses
from cmig_jax.nn.attention import PairTransformer
from cmig_jax.nn.build import build
from cmig_jax.parity.recorded import Arrays, Inputs, Run
from cmig_jax.parity.sizes import sizes_of
from cmig_jax.parity.weights import by_torch_name
from cmig_jax.structs import Batch, Prediction, RigidTransform

Dtype = Literal["float64", "float32"]
Variables = Mapping[str, Any]


@dataclass(frozen=True)
class FlaxPass:
    """One pass of the network as JAX gave it: terms of the loss by name, gradients like `params`, new statistics."""

    prediction: Prediction
    transformed: tuple[jax.Array, ...]
    terms: dict[str, jax.Array]
    gradients: Any
    batch_stats: Any


def run_flax(config: Config, variables: Variables, inputs: Inputs, train: bool, dtype: Dtype = "float64") -> Run:
    """Run forward, and in training mode backward.

    Args:
        config: the released network's flags, for any sizes.
        variables: its `params` and `batch_stats`.
        inputs: the pairs; training needs `src_idx`.
        train: training mode.
        dtype: what to compute in.
    """
    with jax.enable_x64(dtype == "float64"):
        cast = jax.tree.map(lambda x: jnp.asarray(x, dtype), dict(variables))
        done = make_pass(config, train)(cast, make_batch(inputs, dtype), source_index(inputs))
        outputs = _outputs(done.prediction, done.transformed)
        if not train:
            return Run(outputs, {}, by_torch_name({"batch_stats": cast["batch_stats"]}, sizes_of(config.model)))
        outputs["loss_terms"] = np.array([done.terms.get(name, 0.0) for name in term_names(config)])
        outputs["loss"] = np.asarray(sum(done.terms.values()))
        gradients = by_torch_name({"params": done.gradients}, sizes_of(config.model))
        return Run(outputs, gradients, by_torch_name({"batch_stats": done.batch_stats}, sizes_of(config.model)))


@cache
def make_pass(config: Config, train: bool) -> Callable[[Variables, Batch, jax.Array | None], FlaxPass]:
    """Compile a pass of the network that `config` describes."""
    network = build(config)

    def forward(params: Any, variables: Variables, batch: Batch, index: jax.Array | None) -> tuple[jax.Array, Any]:
        prediction, new = network.apply(
            {**variables, "params": params},
            batch,
            train=train,
            source_index=index,
            mutable=["batch_stats", "intermediates"],
            capture_intermediates=_is_transformer_call,
        )
        terms = losses(prediction, batch, config.loss) if train else {}
        seen: Any = new["intermediates"]
        transformed = seen.get("transformer", {}).get("__call__", ())
        return sum(terms.values(), jnp.zeros(())), (prediction, transformed, terms, new["batch_stats"])

    @jax.jit
    def compiled(variables: Variables, batch: Batch, index: jax.Array | None) -> Any:
        if not train:
            return None, forward(variables["params"], variables, batch, index)[1]
        (_, aux), gradients = jax.value_and_grad(forward, has_aux=True)(variables["params"], variables, batch, index)
        return gradients, aux

    def run(variables: Variables, batch: Batch, index: jax.Array | None) -> FlaxPass:
        gradients, (prediction, transformed, terms, batch_stats) = compiled(variables, batch, index)
        return FlaxPass(prediction, transformed, terms, gradients, batch_stats)

    return run


def make_batch(inputs: Inputs, dtype: Dtype) -> Batch:
    """Turn inputs, channels second, into what the network reads."""
    return Batch(
        source=jnp.asarray(inputs.src.swapaxes(1, 2), dtype),
        target=jnp.asarray(inputs.tgt.swapaxes(1, 2), dtype),
        views=jnp.asarray(np.moveaxis(inputs.views, 2, -1)[:, None], dtype),
        target_from_source=RigidTransform(R=jnp.asarray(inputs.R_gt, dtype), t=jnp.asarray(inputs.t_gt, dtype)),
    )


def source_index(inputs: Inputs) -> jax.Array | None:
    """Return the training keypoints, if the inputs name them."""
    return None if inputs.src_idx is None else jnp.asarray(inputs.src_idx, jnp.int32)


def term_names(config: Config) -> list[str]:
    """Name the terms of the loss in their recorded order; a term that is off is recorded as 0."""
    names = ["cross_modal", "overlap", "mask"]
    return names + [f"{kind}_{i}" for i in range(config.model.matching.iterations) for kind in ("matching", "credibility")]


def _outputs(prediction: Prediction, transformed: tuple[jax.Array, ...]) -> Arrays:
    outputs: dict[str, Any] = {
        "feat_src": prediction.source_features.swapaxes(1, 2),
        "feat_tgt": prediction.target_features.swapaxes(1, 2),
    }
    names = ("attn_points_0", "attn_points_1", "attn_src_views_0", "attn_tgt_views_0")
    outputs |= {name: value.swapaxes(1, 2) for name, value in zip(names, transformed, strict=False)}
    if prediction.image_features is not None:
        outputs["feat_views"] = prediction.image_features[:, 0]
    if prediction.source_scores is not None:
        outputs |= {"score_a": prediction.source_scores, "score_b": prediction.target_scores}
    for i, iteration in enumerate(prediction.iterations):
        outputs |= {
            f"it{i}/match_F": iteration.feature_match,
            f"it{i}/match_S": iteration.coordinate_match,
            f"it{i}/logit": iteration.logit,
            f"it{i}/svd_src": iteration.source.swapaxes(1, 2),
            f"it{i}/svd_corr": None if iteration.corresponding is None else iteration.corresponding.swapaxes(1, 2),
            f"it{i}/svd_w": iteration.weight,
            f"it{i}/R": iteration.step.R,
            f"it{i}/t": iteration.step.t,
        }
    outputs |= {"R": prediction.target_from_source.R, "t": prediction.target_from_source.t}
    return {name: np.asarray(value) for name, value in outputs.items() if value is not None}


def _is_transformer_call(module: Any, method: str) -> bool:
    return isinstance(module, PairTransformer) and method == "__call__"
