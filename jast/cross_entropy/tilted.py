"""A distribution seen through its latent normal number and moved there: x = Q(Phi(z)) with z ~
N(mean, deviation^2) in place of N(0, 1).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr, ndtri

from jast import distributions as D
from jast.cross_entropy.sequences import cells, latent, quantile

__all__ = ["Tilted", "tilted", "untiltable"]


class Tilted(D.Distribution):
    """What `tilted` makes of a distribution of floats that has a quantile function and its inverse,
    taken number by number.
    """

    def __init__(self, distribution, mean, deviation):
        super().__init__()
        self._distribution, self._mean, self._deviation = distribution, mean, deviation

    @property
    def event_shape(self):
        return self._distribution.event_shape

    @property
    def batch_shape(self):
        return self._distribution.batch_shape

    def _sample_n(self, key, n):
        z = self._mean[None] + self._deviation[None] * jax.random.normal(
            key, (n, *self._mean.shape), self._mean.dtype
        )
        return jax.vmap(lambda z: quantile(self._distribution, z))(z)

    def log_prob(self, value):
        """log p(x) + log N(z; mean, deviation) - log N(z; 0, 1) at z = Phi^-1(cdf(x)), as dz/dx is
        the same in both.
        """
        log_p = self._distribution.log_prob(value)
        z = latent(self._distribution, value)
        e = (z - self._mean) / self._deviation
        gain = 0.5 * (z - e) * (z + e) - jnp.log(self._deviation)
        return log_p + jnp.sum(gain, axis=tuple(range(log_p.ndim, gain.ndim)))


def tilted(dist, mean, deviation):
    """The distribution of x = Q(Phi(z)), z ~ N(mean, deviation^2), Q the quantile function of
    ``dist``; ``mean`` and ``deviation`` are like a value, floats.

    It has samples and log densities. Normal distributions are shifted and scaled, of the whole
    numbers of a Categorical or Bernoulli only the probabilities change: these are exact. Otherwise
    Phi(z) is a float below 1, so that in float32 all z > 5.4 are one x. ValueError names a
    distribution that cannot.
    """
    if isinstance(dist, D.Fixed):
        return dist
    if isinstance(dist, D.Normal):
        return D.Normal(dist.loc + dist.scale * mean, dist.scale * deviation)
    if isinstance(dist, D.MultivariateNormalDiag):
        return D.MultivariateNormalDiag(
            dist.loc + dist.scale_diag * mean, dist.scale_diag * deviation
        )
    if isinstance(dist, D.MultivariateNormalTri):
        return D.MultivariateNormalTri(
            dist.loc + dist.scale_tri @ mean,
            dist.scale_tri * deviation[None, :],
            is_lower=dist.is_lower,
        )
    if isinstance(dist, D.Independent):
        return D.Independent(
            tilted(dist.distribution, mean, deviation), dist.reinterpreted_batch_ndims
        )
    if isinstance(dist, D.Joint):
        return D.Joint(
            jax.tree.map(
                tilted,
                dist.distributions,
                mean,
                deviation,
                is_leaf=lambda d: isinstance(d, D.Distribution),
            )
        )
    if isinstance(dist, D.Where):
        return D.Where(
            dist._pred, tilted(dist._a, mean, deviation), tilted(dist._b, mean, deviation)
        )
    if isinstance(dist, D.Bernoulli):
        return D.Bernoulli(probs=_above(-ndtri(dist.probs), mean, deviation), dtype=dist.dtype)
    if isinstance(dist, D.Categorical):
        return D.Categorical(probs=_cells(dist.probs, mean, deviation), dtype=dist.dtype)
    like = D.event_like(dist)
    if not D.has_cdf(dist) or not (
        hasattr(like, "dtype") and jnp.issubdtype(like.dtype, jnp.floating)
    ):
        raise ValueError(
            f"{type(dist).__name__} cannot be tilted: expected floats with a quantile function and"
            " a distribution function that inverts it"
        )
    return Tilted(dist, mean, deviation)


def untiltable(dist: Any) -> str | None:
    """Why `tilted` cannot serve ``dist``; None where it can."""
    full = lambda v: jax.tree.map(
        lambda s: jnp.full(s.shape, v, D.float_dtype(s.dtype)), D.event_like(dist)
    )
    try:
        tilted(dist, full(0), full(1))
    except ValueError as error:
        return str(error)
    return None


def _above(edge, mean, deviation):
    """P(z >= edge)."""
    return ndtr((mean - edge) / deviation)


def _cells(probs, mean, deviation):
    """P(z in the i-th cell), [..., k], for the cells of N(0, 1) of these probabilities."""
    order, edges = cells(probs)
    end = jnp.full((*edges.shape[:-1], 1), jnp.inf, edges.dtype)
    edges = jnp.concatenate([-end, edges, end], axis=-1)
    a, b = ((e - mean[..., None]) / deviation[..., None] for e in (edges[..., :-1], edges[..., 1:]))
    # in the upper tail from the other side, where the numbers are small
    p = jnp.maximum(jnp.where(a > 0, ndtr(-a) - ndtr(-b), ndtr(b) - ndtr(a)), 0)
    return jnp.take_along_axis(p, jnp.argsort(order, axis=-1), axis=-1)
