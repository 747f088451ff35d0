"""Mixtures of multivariate normal distributions and their fit to weighted samples by expectation
maximisation (Bishop 2006, section 9.2).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.lax import Precision
from jax.scipy.special import logsumexp

from jast._src.core.typing import Array
from jast._src.cross_entropy import gaussian
from jast._src.cross_entropy.gaussian import Gaussian
from jast._src.runtime._jax import is_traced
from jast._src.util import display
from jast._src.util.checks import wrong

__all__ = ["Mixture", "as_mixture", "em", "log_prob", "responsibilities", "sample"]


@display.printable()
class Mixture(NamedTuple):
    """The sum of weights[i] N(means[i], covariances[i]); the weights sum to 1, each covariance is
    positive definite.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> means, covariances = jnp.array([[-1.0], [1.0]]), jnp.ones((2, 1, 1))
        >>> both = ce.Mixture(jnp.array([0.5, 0.5]), means, covariances)  # two bells on a line
        >>> both.means.shape
        (2, 1)
    """

    weights: Array
    """[k]"""
    means: Array
    """[k, d]"""
    covariances: Array
    """[k, d, d]"""


def as_mixture(proposal):
    """The `Mixture` with float arrays of one dtype and weights of sum 1. ValueError, naming
    ``proposal``, for one that is none; of traced parts only shapes.
    """
    if is_traced(proposal):
        weights, means, covariances = (jnp.asarray(v) for v in proposal)
    else:
        dtype = gaussian.widest_float(*proposal)
        weights, means, covariances = (
            gaussian.finite_array("proposal", part, value, dtype)
            for part, value in zip(Mixture._fields, proposal, strict=True)
        )
    k, d = means.shape if means.ndim == 2 else (0, 0)
    if not k or not d or weights.shape != (k,) or covariances.shape != (k, d, d):
        received = weights.shape, means.shape, covariances.shape
        must = "be [k], means [k, d] and covariances [k, d, d]"
        raise wrong("proposal", "weights", must, f"shapes {received}")
    if isinstance(means, jax.Array):
        return Mixture(weights, means, covariances)
    if not ((weights >= 0).all() and weights.sum() > 0):
        raise ValueError(f"proposal: weights must be at least 0 and not all 0, received {weights}")
    for c in covariances:
        gaussian.check_covariance("proposal", c)
    return Mixture(*(jnp.asarray(a) for a in (weights / weights.sum(), means, covariances)))


def sample(key, m, n):
    """``n`` draws [n, d], each of a component of its own."""
    which, where = jax.random.split(key)
    i = jax.random.categorical(which, jnp.log(m.weights), shape=(n,))
    z = jax.random.normal(where, (n, m.means.shape[1]), m.means.dtype)
    factors = jnp.linalg.cholesky(m.covariances)
    return m.means[i] + jnp.einsum("nde,ne->nd", factors[i], z, precision=Precision.HIGHEST)


def log_prob(m, x):
    """Log density [...] at ``x`` [..., d]."""
    return logsumexp(_log_joint(m, x), axis=-1)


def responsibilities(m, x):
    """[..., k]: with what probability each component made ``x`` [..., d] (Bishop eq. 9.23). Where
    no density is a number above 0, the weights.
    """
    joint = _log_joint(m, x)
    total = logsumexp(joint, axis=-1, keepdims=True)
    known = jnp.isfinite(total)
    weights = (m.weights / jnp.sum(m.weights)).reshape((1,) * (joint.ndim - 1) + (-1,))
    return jnp.where(known, jnp.exp(joint - jnp.where(known, total, 0)), weights)


def em(
    m, x, weights, iterations=10, regularisation=0.0, least=None, diagonal=False, least_variance=0.0
):
    """``m`` after so many iterations of expectation maximisation for ``x`` [n, d], row i counted
    ``weights[i]`` times: a `Mixture` without NaN.

    ``iterations``: static. ``regularisation`` is added to the diagonals of the new covariances. A
    component with a soft count, the sum of its weighted responsibilities, below ``least`` (default
    d, the rule of R. J. Moss's thesis) keeps its covariance, as does one whose new covariance
    `gaussian.is_definite` refuses; with a count of 0, or data that are not finite, its mean as
    well. So weights are multiplicities, not only ratios. With no regularisation no iteration lowers
    the weighted sum of log densities. A row of weight 0 may hold anything, NaN too.

    With ``diagonal`` the components have diagonal covariances. No variance is below
    ``least_variance``.
    """
    least = x.shape[1] if least is None else least
    numbers = tuple(jnp.asarray(v).astype(x.dtype) for v in (regularisation, least, least_variance))
    weights = weights.astype(x.dtype)
    counted = weights > 0
    x, w = jnp.where(counted[:, None], x, 0), jnp.where(counted, weights, 0)

    def iterate(_, m):
        return _em_iteration(m, x, w, diagonal, *numbers)

    return lax.fori_loop(0, iterations, iterate, m)


def _em_iteration(m, x, w, diagonal, regularisation, least, least_variance):
    """One E and one M step, Bishop eq. 9.23 to 9.27."""
    n, d = x.shape
    eye = jnp.eye(d, dtype=x.dtype)[None]
    tiny, eps = (float(getattr(jnp.finfo(x.dtype), name)) for name in ("tiny", "eps"))
    r = jnp.where(w[:, None] > 0, w[:, None] * responsibilities(m, x), 0)
    count = jnp.sum(r, axis=0)  # eq. 9.27
    r = r / jnp.where(count > 0, count, 1)[None]
    means, covariances = jax.vmap(gaussian.moments, (None, 1))(x, r)  # eq. 9.24, 9.25
    covariances = covariances * eye if diagonal else covariances
    covariances = covariances + regularisation * eye
    variances = jnp.diagonal(covariances, axis1=1, axis2=2)
    covariances = covariances + jnp.maximum(least_variance - variances, 0)[:, :, None] * eye
    # below, the sums of underflowing numbers are no longer averages
    moved = (count > tiny / eps) & jnp.all(jnp.isfinite(means), axis=1)
    definite = jax.vmap(lambda c, mean: gaussian.is_definite(c, mean, n))(covariances, means)
    spread = moved & (count >= least) & definite
    total = jnp.sum(count)
    # eq. 9.26; its log stays finite
    share = jnp.maximum(count / jnp.where(total > 0, total, 1), tiny)
    return Mixture(
        jnp.where(jnp.isfinite(total) & (total > 0), share / jnp.sum(share), m.weights),
        jnp.where(moved[:, None], means, m.means),
        jnp.where(spread[:, None, None], covariances, m.covariances),
    )


def _log_joint(m, x):
    """[..., k]: log of weight times density."""
    values = jax.vmap(
        lambda mean, covariance: gaussian.log_prob(Gaussian(mean, covariance), x), out_axes=-1
    )(m.means, m.covariances)
    return values + jnp.log(m.weights).reshape((1,) * (values.ndim - 1) + (-1,))
