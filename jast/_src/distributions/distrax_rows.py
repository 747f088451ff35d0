"""The rows of the families that distrax has, too: each serves both classes of its name."""

import math

import jax
import jax.numpy as jnp
from jax.scipy.special import expit, log_ndtr, logit

from jast._src.distributions import continuous, discrete, operations
from jast._src.distributions.family_table import register, register_both
from jast._src.distributions.normal_tails import (
    cell,
    cells,
    fraction,
    inside,
    ndtr,
    ndtri,
    standard,
)


def _quantile_laplace(d, u):
    v = inside(u) - 0.5
    return d.loc - d.scale * jnp.sign(v) * jnp.log1p(-2 * jnp.abs(v))


def _cdf_laplace(d, x):
    z = standard(x - d.loc, d.scale)
    tail = jnp.exp(-jnp.abs(z)) / 2
    return jnp.where(z < 0, tail, 1 - tail)


def _normal_of_laplace(d, x):
    v = (x - d.loc) / d.scale
    return -jnp.sign(v) * ndtri(jnp.exp(-jnp.abs(v)) / 2)


def _laplace_of_normal(d, z):
    return d.loc - d.scale * jnp.sign(z) * (math.log(2.0) + log_ndtr(-jnp.abs(z)))


register_both(
    continuous.Laplace,
    quantile=_quantile_laplace,
    cdf=_cdf_laplace,
    from_normal=_laplace_of_normal,
    to_normal=_normal_of_laplace,
)


def _normal_of_logistic(d, x):
    v = (x - d.loc) / d.scale
    return -jnp.sign(v) * ndtri(jax.nn.sigmoid(-jnp.abs(v)))


register_both(
    continuous.Logistic,
    quantile=lambda d, u: d.loc + d.scale * logit(inside(u)),
    cdf=lambda d, x: expit(standard(x - d.loc, d.scale)),
    from_normal=lambda d, z: d.loc + d.scale * (log_ndtr(z) - log_ndtr(-z)),
    to_normal=_normal_of_logistic,
)


def _uniform_of_normal(d, z):
    part = (d.high - d.low) * ndtr(jnp.where(z < 0, z, -z))
    return jnp.where(z < 0, d.low + part, d.high - part)


def _normal_of_uniform(d, x):
    x = jnp.clip(x, d.low, d.high)
    # at an end of the support half a unit of rounding from there
    least = jnp.maximum(jnp.abs(x) * (jnp.finfo(x.dtype).eps / 4), jnp.finfo(x.dtype).tiny)
    below, above = (jnp.maximum(gap, least) / (d.high - d.low) for gap in (x - d.low, d.high - x))
    z = ndtri(jnp.where(below < above, below, jnp.minimum(above, 0.5)))
    return jnp.where(below < above, z, -z)


register_both(
    continuous.Uniform,
    quantile=lambda d, u: d.low + u * (d.high - d.low),
    cdf=lambda d, x: fraction(x, d.low, d.high),
    from_normal=_uniform_of_normal,
    to_normal=_normal_of_uniform,
    mode=lambda d: (d.low + d.high) / 2,  # any point is one; the middle is the undisturbed one
)


# whole numbers


def _tilted_bernoulli(d, mean, deviation):
    edge = -ndtri(d.probs)
    return discrete.Bernoulli(probs=ndtr((mean - edge) / deviation), dtype=d.dtype)


register_both(
    discrete.Bernoulli,
    quantile=lambda d, u: jnp.asarray(u >= 1 - d.probs, d.dtype),
    cdf=lambda d, x: cell(x, (1 - d.probs)[..., None]),
    from_normal=lambda d, z: jnp.asarray(z >= -ndtri(d.probs), d.dtype),
    tilt=_tilted_bernoulli,
)


def _quantile_of_choice(d, u):
    below = jnp.cumsum(d.probs, axis=-1)[..., :-1]
    return jnp.sum(u[..., None] >= below, axis=-1).astype(d.dtype)


def _choice_of_normal(d, z):
    order, edges = cells(d.probs)
    i = jnp.sum(z[..., None] >= edges, axis=-1)
    return jnp.take_along_axis(order, i[..., None], axis=-1)[..., 0].astype(d.dtype)


def _with_infinite_ends(edges):
    """``edges`` of cells between the ends of the line."""
    end = jnp.full((*edges.shape[:-1], 1), jnp.inf, edges.dtype)
    return jnp.concatenate([-end, edges], -1), jnp.concatenate([edges, end], -1)


def _normal_of_choice(d, x):
    order, edges = cells(d.probs)
    i = jnp.argmax(order == x[..., None].astype(order.dtype), axis=-1)[..., None]
    low, high = (jnp.take_along_axis(e, i, axis=-1)[..., 0] for e in _with_infinite_ends(edges))
    # the middle in probability, from the side where the numbers are small
    return jnp.where(
        low + high > 0, -ndtri((ndtr(-low) + ndtr(-high)) / 2), ndtri((ndtr(low) + ndtr(high)) / 2)
    )


def _tilted_choice(d, mean, deviation):
    """P(z in the i-th cell), for the cells of N(0, 1) of these probabilities."""
    order, edges = cells(d.probs)
    a, b = ((e - mean[..., None]) / deviation[..., None] for e in _with_infinite_ends(edges))
    # in the upper tail from the other side, where the numbers are small
    p = jnp.maximum(jnp.where(a > 0, ndtr(-a) - ndtr(-b), ndtr(b) - ndtr(a)), 0)
    p = jnp.take_along_axis(p, jnp.argsort(order, axis=-1), axis=-1)
    return discrete.Categorical(probs=p, dtype=d.dtype)


register_both(
    discrete.Categorical,
    quantile=_quantile_of_choice,
    cdf=lambda d, x: cell(x, jnp.cumsum(d.probs, axis=-1)[..., :-1]),
    from_normal=_choice_of_normal,
    to_normal=_normal_of_choice,
    tilt=_tilted_choice,
)


# distrax's Transformed, of numbers one by one


def _elementwise(d):
    return d.bijector.event_ndims_in == d.bijector.event_ndims_out == 0


def _quartiles(d, like):
    """The values at the quantiles 1/4 and 3/4 of the base: which of them is larger says whether the
    bijector falls.
    """
    return tuple(
        d.bijector.forward(operations.quantile(d.distribution, jnp.full_like(like, q)))
        for q in (0.25, 0.75)
    )


def _falls(d, like):
    x0, x1 = _quartiles(d, like)
    return x1 < x0


def _forward(d, verb, at, opposite):
    """The value at a number, by ``verb`` of the base, which has the tails: ``at`` this number, or
    at its ``opposite`` where the bijector falls and swaps them.
    """
    if not _elementwise(d):
        raise operations.no_quantile(d)
    return d.bijector.forward(verb(d.distribution, jnp.where(_falls(d, at), opposite, at)))


def _inverse(d, verb, x):
    """The number of ``x``, by ``verb`` of the base."""
    if not _elementwise(d):
        raise ValueError(f"cdf: {type(d).__name__} has no quantile function here to invert")
    try:
        y = d.bijector.inverse(x)
    except NotImplementedError:
        raise ValueError(f"cdf: {type(d).__name__} has a bijector without inverse") from None
    return verb(d.distribution, y)


def _cdf_transformed(d, x):
    u = _inverse(d, operations.cdf, x)
    x0, x1 = _quartiles(d, x)
    u = jnp.where(x1 >= x0, u, 1 - u)
    within = (u > 0) & (u < 1)  # off the support the inverse may be NaN, or of either end
    return jnp.where(within, u, (x >= (x0 + x1) / 2).astype(u.dtype))


def _normal_of_transformed(d, x):
    z = _inverse(d, operations.to_normal, x)
    return jnp.where(_falls(d, x), -z, z)


register(
    "distrax:Transformed",
    quantile=lambda d, u: _forward(d, operations.quantile, u, 1 - u),
    cdf=_cdf_transformed,
    from_normal=lambda d, z: _forward(d, operations.from_normal, z, -z),
    to_normal=_normal_of_transformed,
    exact=lambda d: operations.has_exact_tails(d.distribution),
)
