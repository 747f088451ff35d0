"""What several families need: the normal distribution in both tails, fractions, cells."""

from __future__ import annotations

import math
import sys
from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy import special
from jax.scipy.special import log_ndtr

from jast._src.core.typing import Array

__all__ = [
    "HALF_LOG_2PI",
    "cell",
    "cells",
    "float_dtype",
    "fraction",
    "inside",
    "log_one_less",
    "log_tails",
    "ndtr",
    "ndtri",
    "normal_of_log_tails",
    "normal_score",
    "phi",
    "standard",
]

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)  # minus the log density of N(0, 1) at 0
LEAST_LOG_TAIL = math.log(sys.float_info.min)  # z = -37.5
ROUNDS = 3  # 1 / z^2 is 6e-3 where they begin in float32


@jax.custom_jvp
def ndtr(z: jax.Array) -> jax.Array:
    """The normal distribution function Phi. Its derivative is told: through the series that compute
    it a program of gradients would be several times as large, and as long in the compiler.
    """
    return special.ndtr(z)


@ndtr.defjvp
def _ndtr_jvp(primals: Any, tangents: Any) -> Any:
    (z,), (slope,) = primals, tangents
    return ndtr(z), slope * jnp.exp(-0.5 * jnp.square(z) - HALF_LOG_2PI)


@jax.custom_jvp
def ndtri(p: jax.Array) -> jax.Array:
    """The normal quantile function Phi^-1, likewise."""
    return special.ndtri(p)


@ndtri.defjvp
def _ndtri_jvp(primals: Any, tangents: Any) -> Any:
    (p,), (slope,) = primals, tangents
    z = ndtri(p)
    return z, slope * jnp.exp(0.5 * jnp.square(z) + HALF_LOG_2PI)


def float_dtype(dtype: Any) -> Any:
    """The dtype itself where it is floating, else the default float.

    Args:
        dtype: any.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> D.float_dtype(jnp.dtype("int32")).name
        'float32'
    """
    return dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.zeros(()).dtype


def phi(z: jax.Array) -> jax.Array:
    """The normal distribution function, kept below 1.

    Args:
        z: normal numbers.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.phi(jnp.array(0.0)))
        0.5
    """
    return jnp.minimum(ndtr(z), 1 - jnp.finfo(z.dtype).epsneg)


def normal_score(u: jax.Array) -> jax.Array:
    """Phi^-1(u), finite: what rounds to 0 or 1 counts as half a unit of rounding from there."""
    eps = jnp.finfo(u.dtype).eps
    return ndtri(jnp.where(u > 0, jnp.minimum(u, 1 - eps / 2), eps / 2))


def inside(u: jax.Array) -> jax.Array:
    """Keep ``u`` off 0 and 1, where an unbounded quantile is infinite."""
    eps = jnp.finfo(u.dtype).eps
    return jnp.clip(u, eps / 2, 1 - eps)


def fraction(x: Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """The part of the way from ``low`` to ``high`` at which ``x`` is, in [0, 1].

    Args:
        x: where.
        low, high: the ends; 0.5 where they are the same.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> float(D.fraction(jnp.array(3.0), jnp.array(2.0), jnp.array(6.0)))
        0.25
    """
    none = high == low
    return jnp.where(none, 0.5, jnp.clip((x - low) / jnp.where(none, 1, high - low), 0, 1))


def standard(gap: jax.Array, scale: jax.Array) -> jax.Array:
    """``gap / scale``; where the scale is 0, a gap of 0 stays 0."""
    return gap / jnp.maximum(scale, jnp.finfo(scale.dtype).tiny)


def cell(x: jax.Array, inner: jax.Array) -> jax.Array:
    """Middle of the ``x``-th of the intervals of [0, 1] that begin at 0 and at each of ``inner``
    (on the last axis); 0 or 1 where there is none.
    """
    end = jnp.zeros((*inner.shape[:-1], 1), inner.dtype)
    starts, last = jnp.concatenate([end, inner, end + 1], axis=-1), inner.shape[-1]
    v = jnp.asarray(x).astype(inner.dtype)
    i = jnp.clip(jnp.floor(v), 0, last).astype(jnp.int32)[..., None]
    low, high = (jnp.take_along_axis(starts, j, axis=-1)[..., 0] for j in (i, i + 1))
    middle = (low + high) / 2
    middle = jnp.where(middle < high, middle, low)  # an interval holds its start alone
    return jnp.clip(jnp.where((v < 0) | (v > last), v, middle), 0, 1).astype(
        float_dtype(jnp.result_type(x))
    )


def cells(probs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(the whole numbers by falling probability [..., k], the z between them [..., k - 1]): rare
    ones lie in the upper tail, where more noise reaches them.
    """
    order = jnp.argsort(-probs, axis=-1)
    p = jnp.take_along_axis(probs / jnp.sum(probs, axis=-1, keepdims=True), order, axis=-1)
    below = jnp.cumsum(p, axis=-1)[..., :-1]
    above = jnp.flip(jnp.cumsum(jnp.flip(p, axis=-1), axis=-1), axis=-1)[..., 1:]
    return order, jnp.where(below < 0.5, ndtri(below), -ndtri(above))


def log_tails(z: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(log Phi(z), log Phi(-z)), each to the precision of its own size: ``log_ndtr`` of a positive
    number is the log of a float below 1, of which in float32 an eighth is lost at z = 5.
    """
    small = log_ndtr(-jnp.abs(z))
    large = log_one_less(small)
    return jnp.where(z < 0, small, large), jnp.where(z < 0, large, small)


def log_one_less(log_p: jax.Array) -> jax.Array:
    """log(1 - p) of log p <= 0, precise for p near 0 and near 1."""
    near_one = log_p > -math.log(2.0)
    other = jnp.where(near_one, -1.0, log_p)
    return jnp.where(
        near_one, jnp.log(-jnp.expm1(jnp.where(near_one, log_p, -1.0))), jnp.log1p(-jnp.exp(other))
    )


def normal_of_log_tails(log_below: jax.Array, log_above: jax.Array) -> jax.Array:
    """The z of `log_tails`, from the smaller of the two; where that is of a probability of 0, which
    may have been rounded to it, the z of the least float.
    """
    dtype, small = log_below.dtype, jnp.minimum(log_below, log_above)
    least = math.log(jnp.finfo(dtype).tiny)  # z = -12.9 in float32, -37.5 in float64
    small = jnp.where(small == -jnp.inf, least, small)
    small = jnp.clip(small, LEAST_LOG_TAIL, -math.log(2.0))
    representable = least + 1
    z = ndtri(jnp.exp(jnp.maximum(small, representable)))
    # beyond, log Phi(z) = -z^2 / 2 - log((2 pi)^.5 |z|) + log(1 - 1 / z^2 + 3 / z^4 ...), solved
    # for z^2 by substitution: each round leaves an error 1 / z^2 times that of the last
    most = -2 * jnp.minimum(small, representable)
    square = most
    for _ in range(ROUNDS):
        series = jnp.log1p((3 / square - 1) / square)
        square = most - 2 * HALF_LOG_2PI - jnp.log(square) + 2 * series
    z = jnp.where(small < representable, -jnp.sqrt(square), z)
    return jnp.where(log_below < log_above, 1, -1).astype(dtype) * z
