"""Values over all pairs of keypoints as sums of few terms `S_ij (a_i + b_j)`: the first layer of the networks over pairs.

The fast version takes the batch statistics from sums and products over points, and makes the values where they are read, a chunk of
source keypoints at a time (`ops/pair_layers.py`). The plain version makes all values at once.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import struct
from jax import Array

from cmig_jax.ops.moments import Moments, scale_about

HIGHEST = jax.lax.Precision.HIGHEST
MOST_UNROLLED_ROWS = 32


@struct.dataclass
class PairTerm:
    """Values over pairs `scale_ij (row_i + column_j)`: `[B, N, M]`, `[B, N, C]` or None for 0, `[B, M, C]` or `[1, 1, C]`."""

    scale: Array
    row: Array | None
    column: Array

    @property
    def has_one_column(self) -> bool:
        """Whether one vector stands for the columns of all clouds."""
        return self.column.shape[:2] == (1, 1)

    def times(self, factor: Array) -> PairTerm:
        """Multiply the channels by `factor [C]`."""
        factor = factor[None, None, :]
        return PairTerm(self.scale, None if self.row is None else self.row * factor, self.column * factor)


@struct.dataclass
class PairSum:
    """Values over pairs: `row_i` `[B, N, C]` plus terms."""

    row: Array
    terms: tuple[PairTerm, ...]

    def __add__(self, other: PairSum) -> PairSum:
        return PairSum(self.row + other.row, self.terms + other.terms)

    def scale_about(self, mean: Array, scale: Array, bias: Array) -> PairSum:
        """Return `(x - mean) * scale + bias` for channel vectors `[C]`."""
        row = scale_about(self.row, mean, scale, "fast") + bias[None, None, :]
        return PairSum(row, tuple(t.times(scale) for t in self.terms))


def plain_values(pairs: PairSum) -> Array:
    """Return the values `[B, N, M, C]`."""
    total = pairs.row[:, :, None]
    for t in pairs.terms:
        column = t.column[:, None]
        total = total + t.scale[..., None] * (column if t.row is None else column + t.row[:, :, None])
    return total


fast_values = jax.custom_vjp(plain_values)


def _values_backward(pairs: PairSum, gradient: Array) -> tuple[PairSum]:
    """Sums over columns and channels are written as products: XLA's sums take many times as long on a CPU."""
    weights = jnp.stack([jnp.ones_like(pairs.terms[0].scale), *(t.scale for t in pairs.terms)], axis=2)
    of_rows = jnp.einsum("bntm,bnmc->bntc", weights, gradient, precision=HIGHEST)
    terms = []
    for i, t in enumerate(pairs.terms, 1):
        if t.has_one_column:
            of_column = jnp.sum(of_rows[:, :, i], axis=(0, 1), keepdims=True)
            of_scale = jnp.matmul(gradient, t.column[0, 0], precision=HIGHEST)
        else:
            of_column = _sum_of_rows(t.scale, gradient)
            of_scale = jnp.matmul(gradient * t.column[:, None], jnp.ones_like(gradient[0, 0, 0]), precision=HIGHEST)
        if t.row is not None:
            of_scale = of_scale + jnp.einsum("bnmc,bnc->bnm", gradient, t.row, precision=HIGHEST)
        terms.append(PairTerm(of_scale, None if t.row is None else of_rows[:, :, i], of_column))
    return (PairSum(of_rows[:, :, 0], tuple(terms)),)


def _sum_of_rows(weight: Array, x: Array) -> Array:
    """Sum `weight [B, N, M]` times `x [B, N, M, C]` over N, to `[B, M, C]`; few rows are added one by one in one pass."""
    if weight.shape[1] > MOST_UNROLLED_ROWS:
        return jnp.einsum("bnm,bnmc->bmc", weight, x, precision=HIGHEST)
    total = weight[:, 0, :, None] * x[:, 0]
    for i in range(1, weight.shape[1]):
        total = total + weight[:, i, :, None] * x[:, i]
    return total


fast_values.defvjp(lambda pairs: (plain_values(pairs), pairs), _values_backward)


def fast_moments(pairs: PairSum) -> Moments:
    """Return mean and variance per channel from sums over points; everything is centred first, so that squares keep their digits."""
    row, column, terms = pairs.row, jnp.zeros_like(pairs.row[:1, :1]), []
    for t in pairs.terms:
        middle = jnp.mean(t.scale)
        row = row if t.row is None else row + middle * t.row
        column = column + middle * t.column
        terms.append(PairTerm(t.scale - middle, t.row, t.column))
    means = [jnp.mean(x, axis=(0, 1), keepdims=True) for x in (row, column)]
    terms.append(PairTerm(jnp.ones_like(terms[0].scale), row - means[0], column - means[1]))
    first, second = jnp.zeros_like(row[0, 0]), jnp.zeros_like(row[0, 0])
    for i, one in enumerate(terms):
        first += _total(one)
        second += _product_of(one, one)
        for other in terms[:i]:
            second += 2 * _product_of(one, other)
    count = terms[0].scale.size
    mean = first / count
    return Moments(mean=mean + (means[0] + means[1])[0, 0], variance=second / count - mean**2, count=count)


def _total(term: PairTerm) -> Array:
    """Sum a term over pairs, `[C]`."""
    if term.has_one_column:
        total = jnp.sum(term.scale) * term.column[0, 0]
    else:
        total = jnp.sum(jnp.sum(term.scale, axis=1)[..., None] * term.column, axis=(0, 1))
    return total if term.row is None else total + jnp.sum(jnp.sum(term.scale, axis=2)[..., None] * term.row, axis=(0, 1))


def _product_of(one: PairTerm, other: PairTerm) -> Array:
    """Sum the product of two terms over pairs, `[C]`."""
    both = one.scale * other.scale
    rows = None if one.row is None or other.row is None else one.row * other.row
    total = _total(PairTerm(both, rows, one.column * other.column))
    for row, term in ((one.row, other), (other.row, one)):
        if row is not None:
            total = total + jnp.sum(row * _over_columns(both, term), axis=(0, 1))
    return total


def _over_columns(weight: Array, term: PairTerm) -> Array:
    """Sum `weight_ij column_j` over the columns of a term, `[B, N, C]`."""
    if term.has_one_column:
        return jnp.sum(weight, axis=2)[..., None] * term.column
    return jnp.einsum("bnm,bmc->bnc", weight, term.column, precision=HIGHEST)
