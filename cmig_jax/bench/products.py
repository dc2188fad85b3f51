"""Matrix products and convolutions of a program: how many operations and bytes, and how fast this machine does a large one.

XLA's own count takes the body of a loop once, and our networks over pairs and images are loops.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr

REPETITIONS = 5
SIDE = {"cpu": 2048}
SIDE_ON_ACCELERATORS = 8192


@dataclass(frozen=True)
class Products:
    """Multiplications and additions, and the bytes that operands and results have if each product reads and writes them once."""

    operations: int = 0
    bytes: int = 0

    def __add__(self, other: Products) -> Products:
        return Products(self.operations + other.operations, self.bytes + other.bytes)

    def __mul__(self, times: int) -> Products:
        return Products(self.operations * times, self.bytes * times)


def products_of(program: Jaxpr | ClosedJaxpr) -> Products:
    """Count the products of a traced program, those of a `scan` as often as it runs (of a `while`, whose end is not known, once)."""
    total = Products()
    for equation in (program.jaxpr if isinstance(program, ClosedJaxpr) else program).eqns:
        if equation.primitive.name in ("dot_general", "conv_general_dilated"):
            total += _product(equation)
        inner = [products_of(part) for part in _programs(equation.params)]
        if equation.primitive.name == "cond":
            inner = [max(inner, key=lambda products: products.operations)]
        total += sum(inner, Products()) * equation.params.get("length", 1)
    return total


def _product(equation: Any) -> Products:
    left, right, result = (x.aval for x in (*equation.invars, *equation.outvars))
    if equation.primitive.name == "dot_general":
        (summed, _), _ = equation.params["dimension_numbers"]
        operations = 2 * result.size * math.prod(left.shape[axis] for axis in summed)
    else:
        outputs = right.shape[equation.params["dimension_numbers"].rhs_spec[0]]
        zeros = math.prod(equation.params["lhs_dilation"])  # that a stride's derivative inserts between its numbers: not counted
        operations = 2 * result.size * (right.size // outputs) // zeros
    return Products(operations, sum(x.size * x.dtype.itemsize for x in (left, right, result)))


def _programs(parameters: dict[str, Any]) -> Iterator[Jaxpr | ClosedJaxpr]:
    for value in parameters.values():
        for part in value if isinstance(value, (list, tuple)) else (value,):
            if isinstance(part, (Jaxpr, ClosedJaxpr)):
                yield part


def product_rate(dtype: jnp.dtype) -> float:
    """Measure operations per second of a large matrix product in this type, the fastest of some."""
    side = SIDE.get(jax.default_backend(), SIDE_ON_ACCELERATORS)
    matrix = jnp.ones((side, side), dtype)
    product = jax.jit(jnp.matmul).lower(matrix, matrix).compile()
    seconds = []
    for _ in range(1 + REPETITIONS):
        start = time.perf_counter()
        product(matrix, matrix).block_until_ready()
        seconds.append(time.perf_counter() - start)
    return 2 * side**3 / min(seconds)
