"""Gaussian process regression on a padded, masked set of points, with its hyperparameters chosen
from a grid: no branch, no iteration, so it vmaps.

Zero mean, one lengthscale for all coordinates (Rasmussen and Williams 2006, Gaussian processes for
machine learning, ch. 2, 4 and 5). The signal's variance is that of greatest likelihood at each
point of the grid, in closed form; the noise is relative to it.
"""

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jax.tree_util import register_dataclass

__all__ = ["JITTER", "KERNELS", "LENGTHSCALES", "fit", "predict", "squared_distances"]

LENGTHSCALES = tuple(10 ** (-1.7 + 2.1 * i / 11) for i in range(12))
"""The grid, as multiples of a scale: 0.02 to 2.5; a convention."""
NOISES = (1e-4, 1e-2)
"""The grid of the noise's variance, as shares of the signal's; a convention."""
JITTER = 1e-6  # added to every noise, so that float32 factors stay positive definite


def _squared_exponential(r2):
    return jnp.exp(-0.5 * r2)  # R&W eq. 4.9


def _matern(terms, r2):
    """R&W eq. 4.17: a polynomial of sqrt(2 nu) r times its decaying exponential."""
    # sqrt has no derivative at 0
    r = jnp.sqrt((2 * len(terms) - 1) * r2 + jnp.finfo(r2.dtype).tiny)
    return jnp.exp(-r) * sum(c * r**i for i, c in enumerate(terms))


KERNELS = {
    "squared exponential": _squared_exponential,
    "matern12": lambda r2: _matern((1.0,), r2),
    "matern32": lambda r2: _matern((1.0, 1.0), r2),
    "matern52": lambda r2: _matern((1.0, 1.0, 1 / 3), r2),
}
"""Correlation as a function of the squared distance in lengthscales."""


@register_dataclass
@dataclass(frozen=True)
class GaussianProcess:
    """A fitted process: what `predict` needs."""

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
    kernel: str = field(default="squared exponential", metadata=dict(static=True))


def fit(x, y, mask, lengthscales, noises=NOISES, kernel="squared exponential"):
    """The `GaussianProcess` of points ``x`` [n, d] with values ``y`` [n] where ``mask`` [n]; of the
    grid ``lengthscales`` [a] x ``noises`` [b], the likeliest.

    Rows that are masked may hold anything, NaN too. ValueError for an unknown kernel and shapes
    that do not fit.
    """
    if kernel not in KERNELS:
        raise ValueError(
            f"gaussian_process.fit: kernel must be one of {list(KERNELS)}, received {kernel!r}"
        )
    if x.ndim != 2 or y.shape != x.shape[:1] or mask.shape != y.shape:
        raise ValueError(
            f"gaussian_process.fit: x must be [n, d], y and mask [n], received {x.shape}, {y.shape}"
            f" and {mask.shape}"
        )
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
    k = jnp.where(both, KERNELS[kernel](r2 / lengthscale**2), 0) + jnp.diag(
        jnp.where(mask, noise, 1)
    )
    factor = jnp.linalg.cholesky(k)
    weights = cho_solve((factor, True), y)
    n = jnp.sum(mask, dtype=y.dtype)
    # of greatest likelihood: d/dv of eq. 2.30 = 0
    variance = jnp.maximum(y @ weights / jnp.maximum(n, 1), jnp.finfo(y.dtype).tiny)
    # R&W eq. 2.30 with that variance, for which the data's term is n / 2
    log_likelihood = -0.5 * n * (1 + jnp.log(variance) + math.log(2 * math.pi)) - jnp.sum(
        jnp.log(jnp.diagonal(factor))
    )
    return factor, weights, variance, log_likelihood


def predict(gp, x, variance=False):
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
