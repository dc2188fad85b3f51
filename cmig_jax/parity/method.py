"""Hold a network to the recorded cases of its official implementation: what a method declares, and the comparison.

A case is a training case if it has gradients. In training the recorded draws are fed in; everything else is computed, in float64.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import NDArray

from cmig_jax.config import ComputeConfig, Kernels, ModelFlags
from cmig_jax.models.networks import model_of
from cmig_jax.parity.cases import Arrays, Case, State
from cmig_jax.parity.rows import Row, compare_all
from cmig_jax.parity.weights import COUNTER, Layout, by_torch_name, named_weights, to_flax
from cmig_jax.structs import Batch, Prediction
from cmig_jax.transform import RigidTransform

Stages = Mapping[str, Callable[[int], Sequence[str]]]


@dataclass(frozen=True)
class Outcome:
    """The results of one pass.

    Attributes:
        stages: what the watched methods of the network returned, by name, in its own layout (channels last).
        prediction: of the network, NumPy arrays.
        terms: of the loss.
        inputs: of the case.
    """

    stages: Arrays
    prediction: Any
    terms: Mapping[str, NDArray]
    inputs: Arrays


@dataclass(frozen=True)
class Method:
    """A network's recorded cases.

    Attributes:
        name: folder of the recorded cases, and value of `--method`.
        network: key of the network in `models.networks.NETWORKS`.
        flags_of_case: the flags of the network that a case was recorded with.
        flags_of_state: the flags of a network with a state's shapes; raises ValueError for another network's state.
        layout: the tensors of its `state_dict`, in order.
        inputs: names of the inputs and recorded draws, with their axes, such as `B N 3`.
        optional: those inputs that some cases do not have.
        batch: makes the network's input (float64 NumPy arrays) of the inputs.
        stages: methods of the network's modules, as `Class.method`, and the names of the leaves that their call number i returns.
        results: names the results as the case does, in its layout, from an outcome; `loss`, gradients and statistics are added.
        draws: the recorded draws as further arguments of the network.
        overrides: changes of single tensors of the case's weights, by the name of the tensor: `+` adds, `*` multiplies, `=` replaces.
        with_loss: whether evaluation cases record the loss too.
    """

    name: str
    network: str
    flags_of_case: Callable[[Case], ModelFlags]
    flags_of_state: Callable[[State], ModelFlags]
    layout: Callable[[Any], Layout]
    inputs: Mapping[str, str]
    batch: Callable[[Arrays], Batch]
    stages: Stages
    results: Callable[[Outcome], Arrays]
    optional: tuple[str, ...] = ()
    draws: Callable[[Case], Mapping[str, NDArray]] = lambda _: {}
    overrides: Callable[[Case], Mapping[str, tuple[str, Any]]] = lambda _: {}
    with_loss: bool = True


class Watch:
    """Interceptor that notes what the watched methods of modules return, and counts the batches that each BatchNorm has normalised."""

    def __init__(self, stages: Stages) -> None:
        self.seen: dict[str, Array] = {}
        self.batches = Counter[tuple[str, ...]]()
        self._stages, self._calls = stages, Counter[str]()

    def __call__(self, call: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any], context: Any) -> Any:
        """Run a method, and note its result."""
        stage = f"{type(context.module).__name__}.{context.method_name}"
        result = call(*args, **kwargs)
        if stage == "BatchNorm.affine" and args[0] is not None:
            self.batches[context.module.path] += 1
        if stage in self._stages:
            names = self._stages[stage](self._calls[stage])
            self.seen |= dict(zip(names, jax.tree.leaves(result), strict=True)) if names else {}
            self._calls[stage] += 1
        return result


def is_training(case: Case) -> bool:
    """Return whether a case was recorded in training mode."""
    return any(key.startswith("grad_norm/") for key in case.outputs)


def weights_of(method: Method, case: Case, seed: int = 0) -> Arrays:
    """Return the state that a case was recorded with: a function of the names, the seed and the method's overrides."""
    state = named_weights(method.layout(method.flags_of_case(case)), seed)
    for name, (how, value) in method.overrides(case).items():
        old, value = state[name], np.asarray(value, np.float64)
        state[name] = {"+": lambda a, b: a + b, "*": lambda a, b: a * b, "=": lambda a, b: np.broadcast_to(b, a.shape)}[how](old, value)
    return state


def check_method(method: Method, case: Case, state: State, kernels: Kernels = "auto") -> list[Row]:
    """Compare a network with every recorded result of a case, in float64: one row for each."""
    return compare_all(case.outputs, run_method(method, case, state, kernels), "float64")


def run_method(method: Method, case: Case, state: State, kernels: Kernels = "auto") -> Arrays:
    """Run a network on the inputs of a case; return its results by the recorded names (`cases`)."""
    flags, train = method.flags_of_case(case), is_training(case)
    model = model_of(flags)
    compute = ComputeConfig(kernels=kernels)
    network, layout = model.build(flags, compute), method.layout(flags)

    watch = Watch(method.stages)

    def forward(params: Any, statistics: Any, batch: Batch, draws: Mapping[str, Array]) -> tuple[Array, Any]:
        with nn.intercept_methods(watch):
            variables = {"params": params, "batch_stats": statistics}
            options: dict[str, Any] = {"train": train, "key": None, "mutable": ["batch_stats"], **draws}
            prediction, new = network.apply(variables, batch, **options)
        assert isinstance(prediction, Prediction)
        terms = model.losses(prediction, batch, flags, compute) if train or method.with_loss else {}
        return sum(terms.values(), jnp.zeros(())), (watch.seen, prediction, terms, new.get("batch_stats", {}))

    with jax.enable_x64(True):
        variables, _ = to_flax(state, layout)
        params, statistics = (_wide(variables.get(kind, {})) for kind in ("params", "batch_stats"))
        batch, draws = _wide(method.batch(case.inputs)), {k: jnp.asarray(v) for k, v in method.draws(case).items()}
        if train:
            (_, found), gradients = jax.jit(jax.value_and_grad(forward, has_aux=True))(params, statistics, batch, draws)
        else:
            (_, found), gradients = jax.jit(forward)(params, statistics, batch, draws), {}
        seen, prediction, terms, new = jax.tree.map(np.asarray, found)
        gradients = jax.tree.map(np.asarray, gradients)
    results = method.results(Outcome(seen, prediction, terms, case.inputs))
    if terms:
        results = {"loss": np.asarray(sum(terms.values())), **results}
    for before, tensor in itertools.pairwise(layout if train else ()):  # a norm's counter follows its running statistics
        if tensor.name.endswith(COUNTER) and before.path:
            results[f"statistics/{tensor.name}"] = np.asarray(watch.batches[before.path[1:-1]])
    trees = {"gradient": {"params": gradients}, "statistics": {"batch_stats": new if train else {}}}
    return results | {f"{kind}/{name}": x for kind, tree in trees.items() for name, x in by_torch_name(tree, layout).items()}


def _wide(tree: Any) -> Any:
    """Turn floating-point arrays into float64 and others into what they are, as JAX arrays."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64) if np.asarray(x).dtype.kind == "f" else jnp.asarray(x), tree)


def channels_second(value: NDArray) -> NDArray:
    """Swap points and channels, `[B, N, C]` to `[B, C, N]` or back."""
    return np.swapaxes(value, 1, 2)


def pair_batch(inputs: Mapping[str, Any]) -> Batch:
    """Return the clouds `src` and `tgt`, channels last, and the true pose of a case."""
    return Batch(inputs["src"], inputs["tgt"], target_from_source=RigidTransform(inputs["R_gt"], inputs["t_gt"]))


def pair_batch_channels_second(inputs: Mapping[str, Any]) -> Batch:
    """Return the same of clouds whose channels come second."""
    return pair_batch({**inputs, **{name: channels_second(inputs[name]) for name in ("src", "tgt")}})
