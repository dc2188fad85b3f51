"""Matchings between two sets of which some points have no partner: Sinkhorn's normalisation with slack, in logarithms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array


def log_sinkhorn(affinity: Array, rounds: int) -> Array:
    """Normalise rows and columns in turn, so that neither a row nor a column sums to more than 1 (Yew and Lee, CVPR 2020, Sec. 5.2).

    A slack row and a slack column of ones take the points without a partner; they are never normalised themselves. Each round divides
    the rows, and then the columns, by their sums including the slack. So entry (i, j) stays `affinity_ij - u_i - v_j`, the slack
    column is -u and the slack row -v, and a round is two sums of exponentials.

    Args:
        affinity: `[..., N, M]` logarithms of positive scores.
        rounds: of the normalisation.

    Returns:
        Logarithms `[..., N, M]` of the matching, without the slack. After the last round the columns with their slack sum to 1.
    """
    return log_sinkhorn_with_slack(affinity, rounds)[0]


def log_sinkhorn_with_slack(affinity: Array, rounds: int) -> tuple[Array, Array]:
    """Return `log_sinkhorn` and the logarithm of the slack column, `[..., N]`: how much of each row's point has no partner."""

    def one_round(_: Array, slack: tuple[Array, Array]) -> tuple[Array, Array]:
        u = _with_slack(affinity - slack[1][..., None, :], axis=-1)
        return u, _with_slack(affinity - u[..., None], axis=-2)

    start = jnp.zeros_like(affinity[..., 0]), jnp.zeros_like(affinity[..., 0, :])
    u, v = jax.lax.fori_loop(0, rounds, one_round, start)
    return affinity - u[..., None] - v[..., None, :], -u


def _with_slack(logarithms: Array, axis: int) -> Array:
    """Return log(1 + sum exp) along an axis."""
    return jax.nn.softplus(jax.nn.logsumexp(logarithms, axis=axis))
