"""Cheap models of an objective, fitted to the masked points that were truly evaluated: a Gaussian
process, or least squares on a few basis functions.

Points are centred and scaled first, and values may be warped. What is predicted is only good for
ranking points, which is all that a cross-entropy method does.

The Gaussian process has zero mean and one lengthscale for all coordinates (Rasmussen and Williams
2006, Gaussian processes for machine learning, ch. 2, 4 and 5). Its hyperparameters are chosen from
a grid: no branch, no iteration, so it vmaps. The signal's variance is that of greatest likelihood
at each point of the grid, in closed form; the noise is relative to it.
"""

import math
from itertools import combinations_with_replacement
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular
from jax.scipy.special import ndtri

__all__ = [
    "KERNELS",
    "RADIAL",
    "SURROGATES",
    "WARPS",
    "Frame",
    "fit",
    "warp_values",
    "whitening_frame",
]


LENGTHSCALES = tuple(10 ** (-1.7 + 2.1 * i / 11) for i in range(12))
"""The grid, as multiples of a scale: 0.02 to 2.5; a convention."""
NOISES = (1e-4, 1e-2)  # the grid of the noise's variance, as shares of the signal's; a convention
JITTER = 1e-6  # added to every noise, so that float32 factors stay positive definite


def _matern(terms, r2):
    """R&W eq. 4.17: a polynomial of sqrt(2 nu) r times its decaying exponential."""
    # sqrt has no derivative at 0
    r = jnp.sqrt((2 * len(terms) - 1) * r2 + jnp.finfo(r2.dtype).tiny)
    return jnp.exp(-r) * sum(c * r**i for i, c in enumerate(terms))


KERNELS = {
    "squared exponential": lambda r2: jnp.exp(-0.5 * r2),  # R&W eq. 4.9
    "matern12": lambda r2: _matern((1.0,), r2),
    "matern32": lambda r2: _matern((1.0, 1.0), r2),
    "matern52": lambda r2: _matern((1.0, 1.0, 1 / 3), r2),
}
"""Correlation as a function of the squared distance in lengthscales."""


class GaussianProcess(NamedTuple):
    """A fitted process: what `predict_process` needs."""

    x: jax.Array
    """[n, d]; rows that are masked mean nothing."""
    mask: jax.Array
    """[n] bool"""
    factor: jax.Array
    """[n, n]: lower Cholesky factor of the correlation matrix with noise; a masked row is that of
    the identity.
    """
    weights: jax.Array
    """[n]: the inverse of that matrix times y."""
    lengthscale: jax.Array
    variance: jax.Array
    """Of the signal."""
    noise: jax.Array
    """Relative to ``variance``, jitter included."""
    log_likelihood: jax.Array
    """Of the observed y, at these hyperparameters (R&W eq. 2.30)."""
    kernel: str


def fit_process(x, y, mask, lengthscales, noises=NOISES, kernel="squared exponential"):
    """The `GaussianProcess` of points ``x`` [n, d] with values ``y`` [n] where ``mask`` [n]; of the
    grid ``lengthscales`` [a] x ``noises`` [b], the likeliest.

    Rows that are masked may hold anything, NaN too.
    """
    x, y = jnp.where(mask[:, None], x, 0), jnp.where(mask, y, 0)
    grid = jnp.meshgrid(
        jnp.asarray(lengthscales, x.dtype), jnp.asarray(noises, x.dtype) + JITTER, indexing="ij"
    )
    lengthscale, noise = (a.ravel() for a in grid)
    r2 = squared_distances(x, x)
    factors, weights, variances, values = jax.vmap(
        lambda l, s: _factored(r2, y, mask, l, s, kernel)
    )(lengthscale, noise)
    i = jnp.argmax(jnp.where(jnp.isnan(values), -jnp.inf, values))
    return GaussianProcess(
        x=x,
        mask=mask,
        factor=factors[i],
        weights=weights[i],
        lengthscale=lengthscale[i],
        variance=variances[i],
        noise=noise[i],
        log_likelihood=values[i],
        kernel=kernel,
    )


def _factored(r2, y, mask, lengthscale, noise, kernel):
    """Cholesky factor, weights, signal variance and log likelihood at one point of the grid."""
    both = mask[:, None] & mask[None, :]
    k = jnp.where(both, KERNELS[kernel](r2 / lengthscale**2), 0)
    factor = jnp.linalg.cholesky(k + jnp.diag(jnp.where(mask, noise, 1)))
    weights = cho_solve((factor, True), y)
    n = jnp.sum(mask, dtype=y.dtype)
    # of greatest likelihood: d/dv of eq. 2.30 = 0
    variance = jnp.maximum(y @ weights / jnp.maximum(n, 1), jnp.finfo(y.dtype).tiny)
    # R&W eq. 2.30 with that variance, for which the data's term is n / 2
    of_data = -0.5 * n * (1 + jnp.log(variance) + math.log(2 * math.pi))
    log_likelihood = of_data - jnp.sum(jnp.log(jnp.diagonal(factor)))
    return factor, weights, variance, log_likelihood


def predict_process(gp, x, variance=False):
    """Posterior mean [m] of the noise-free process at ``x`` [m, d], and with ``variance=True`` its
    variance [m] too (R&W eq. 2.25 and 2.26).
    """
    k = jnp.where(gp.mask, KERNELS[gp.kernel](squared_distances(x, gp.x) / gp.lengthscale**2), 0)
    mean = k @ gp.weights
    if not variance:
        return mean
    v = solve_triangular(gp.factor, k.T, lower=True)
    return mean, gp.variance * jnp.maximum(1 - jnp.sum(v**2, axis=0), 0)


def squared_distances(a, b):
    """[n, m] of the points ``a`` [n, d] and ``b`` [m, d]: differences first, as the expanded square
    cancels far from the origin.
    """
    return jnp.sum((a[:, None, :] - b[None, :, :]) ** 2, axis=-1)


class Frame(NamedTuple):
    """Coordinates in which points are compared: z = L^-1 (x - centre)."""

    centre: jax.Array
    """[d]"""
    factor: jax.Array
    """[d, d], lower triangular"""


RADIAL = {
    "gaussian": lambda r2, d: jnp.exp(-0.5 * r2 / d),
    "linear": lambda r2, d: jnp.sqrt(r2 + jnp.finfo(r2.dtype).tiny),
    "squared": lambda r2, d: r2,
    "multiquadratic": lambda r2, d: jnp.sqrt(r2 + 1),
}
"""Radial functions of the squared distance r^2 in the frame, in d dimensions (Kochenderfer and
Wheeler 2019, section 14.4; the names are those of the thesis's code).
"""


def _monomials(x, degree):
    """All monomials up to the degree: [m, C(d + degree, degree)]."""
    products = [
        jnp.prod(x[:, jnp.asarray(which)], axis=1, keepdims=True)
        for k in range(1, degree + 1)
        for which in combinations_with_replacement(range(x.shape[1]), k)
    ]
    return jnp.concatenate([jnp.ones_like(x[:, :1]), *products], axis=1)


SURROGATES = "gaussian process", "linear", "polynomial", "radial basis"
RIDGE = 1e-4  # of the least squares, as a share of the features' mean square; a convention
WARPS = "raw", "standard", "rank"
ROUND = 0.1  # weight of the identity in a frame, so that few points do


def _rank(y, mask):
    """Normal scores: Phi^-1((r + 1/2) / n) of the rank r from 0; equal values share the mean of
    their ranks.
    """
    n = jnp.maximum(jnp.sum(mask, dtype=y.dtype), 1)
    less = jnp.sum((y[None, :] < y[:, None]) & mask[None, :], axis=1, dtype=y.dtype)
    equal = jnp.sum((y[None, :] == y[:, None]) & mask[None, :], axis=1, dtype=y.dtype)
    return jnp.where(mask, ndtri(jnp.clip((less + 0.5 * equal) / n, 1e-4, 1 - 1e-4)), 0)


def warp_values(warp, y, mask):
    """(values to model [n], their mask): non-finite ones are left out, but for the ranks, where
    they are the worst.
    """
    finite = mask & jnp.isfinite(y)
    if warp == "rank":
        return _rank(jnp.where(finite, y, jnp.inf), mask), mask
    y, tiny = jnp.where(finite, y, 0), jnp.finfo(y.dtype).tiny
    if warp == "raw":  # as they are, but for their size
        return y / jnp.maximum(jnp.max(jnp.abs(y)), tiny), finite
    n = jnp.maximum(jnp.sum(finite, dtype=y.dtype), 1)
    centred = jnp.where(finite, y - jnp.sum(y) / n, 0)
    return centred / jnp.maximum(jnp.sqrt(jnp.sum(centred**2) / n), tiny), finite


def whitening_frame(x, mask):
    """The `Frame` in which masked points ``x`` [n, d] have mean 0 and about the identity for
    covariance; a tenth of it is kept round, so that few points do.
    """
    d = x.shape[1]
    n = jnp.maximum(jnp.sum(mask, dtype=x.dtype), 1)
    x = jnp.where(mask[:, None], x, 0)
    centre = jnp.sum(x, axis=0) / n
    z = jnp.where(mask[:, None], x - centre[None], 0)
    variances = jnp.sum(z**2, axis=0) / n
    largest = jnp.maximum(jnp.max(variances), jnp.finfo(x.dtype).tiny ** 0.5)
    # else a coordinate whose points differ by their rounding, or not at all
    spread = variances > (4 * jnp.finfo(x.dtype).eps * centre) ** 2
    variances = jnp.where(spread, variances, largest)
    u = z / jnp.sqrt(variances)[None]
    correlation = (1 - ROUND) * u.T @ u / n + ROUND * jnp.eye(d, dtype=x.dtype)
    return Frame(centre, jnp.sqrt(variances)[:, None] * jnp.linalg.cholesky(correlation))


def fit(kind, x, y, mask, frame, detail):
    """The surrogate of this kind (of `SURROGATES`) for points ``x`` [n, d] with warped values ``y``
    [n], where ``mask`` [n]; ``detail``: the kernel, the degree (of the linear one 1), or the radial
    function.

    It is a function of points [m, d]: what it expects there, [m], on the scale of the warped
    values. With ``optimism`` that is so many standard deviations less; only a Gaussian process
    knows any.
    """
    z = jnp.where(mask[:, None], _in_frame(frame, jnp.where(mask[:, None], x, 0)), 0)
    if kind == "gaussian process":
        gp = fit_process(z, y, mask, LENGTHSCALES, kernel=detail)

        def predict(x, optimism=None):
            if optimism is None:
                return predict_process(gp, _in_frame(frame, x))
            mean, variance = predict_process(gp, _in_frame(frame, x), variance=True)
            return mean - optimism * jnp.sqrt(variance)

        return predict

    def basis(x):
        if kind != "radial basis":
            return _monomials(x, detail)
        return jnp.where(mask[None, :], RADIAL[detail](squared_distances(x, z), x.shape[1]), 0)

    features = jnp.where(mask[:, None], basis(z), 0)
    normal = features.T @ features
    # a masked centre is no feature
    live = jnp.maximum(jnp.sum(jnp.diagonal(normal) > 0, dtype=x.dtype), 1)
    ridge = jnp.maximum(RIDGE * jnp.trace(normal) / live, jnp.finfo(x.dtype).tiny)
    definite = normal + ridge * jnp.eye(len(normal), dtype=x.dtype)
    weights = cho_solve(cho_factor(definite), features.T @ jnp.where(mask, y, 0))
    return lambda x, optimism=None: basis(_in_frame(frame, x)) @ weights


def _in_frame(frame, x):
    return solve_triangular(frame.factor, (x - frame.centre[None]).T, lower=True).T
