"""Cheap models of an objective, fitted to the masked points that were truly evaluated: a Gaussian
process, or least squares on a few basis functions.

Points are centred and scaled first, and values may be warped. What is predicted is only good for
ranking points, which is all that a cross-entropy method does.
"""

from dataclasses import dataclass, field
from itertools import combinations_with_replacement
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular
from jax.scipy.special import ndtri
from jax.tree_util import register_dataclass

from jast.cross_entropy import gaussian_process

__all__ = [
    "RADIAL",
    "SURROGATES",
    "WARPS",
    "Frame",
    "fit",
    "lower_bound",
    "predict",
    "warp_values",
    "whitening_frame",
]


class Frame(NamedTuple):
    """Coordinates in which points are compared: z = L^-1 (x - centre)."""

    centre: jax.Array
    """[d]"""
    factor: jax.Array
    """[d, d], lower triangular"""


class Surrogate(NamedTuple):
    """A fitted model."""

    frame: Frame
    model: "gaussian_process.GaussianProcess | Basis"


@register_dataclass
@dataclass(frozen=True)
class Basis:
    """Least squares on basis functions, which `predict` finds by the kind of the model."""

    x: jax.Array
    """[n, d]: the points, which are the centres of radial basis functions"""
    mask: jax.Array
    """[n] bool"""
    weights: jax.Array
    """[features]"""
    detail: int | str | None = field(default=None, metadata=dict(static=True))
    """The degree of a polynomial, the name of a radial function."""


RADIAL = {
    "gaussian": lambda r2, d: jnp.exp(-0.5 * r2 / d),
    "linear": lambda r2, d: jnp.sqrt(r2 + jnp.finfo(r2.dtype).tiny),
    "squared": lambda r2, d: r2,
    "multiquadratic": lambda r2, d: jnp.sqrt(r2 + 1),
}
"""Radial functions of the squared distance r^2 in the frame, in d dimensions (Kochenderfer and
Wheeler 2019, section 14.4; the names are those of the thesis's code).
"""


def _polynomial(x, centres, mask, degree):
    """All monomials up to the degree: [m, C(d + degree, degree)]."""
    products = [
        jnp.prod(x[:, jnp.asarray(which)], axis=1, keepdims=True)
        for k in range(1, degree + 1)
        for which in combinations_with_replacement(range(x.shape[1]), k)
    ]
    return jnp.concatenate([jnp.ones_like(x[:, :1]), *products], axis=1)


def _radial(x, centres, mask, name):
    r2 = gaussian_process.squared_distances(x, centres)
    return jnp.where(mask[None, :], RADIAL[name](r2, x.shape[1]), 0)


BASES = {"linear": _polynomial, "polynomial": _polynomial, "radial basis": _radial}
DETAILS = {
    "gaussian process": "squared exponential",
    "linear": 1,
    "polynomial": 2,
    "radial basis": "gaussian",
}
"""Of each kind, where none is given: the kernel, the degree (twice), the radial function."""
SURROGATES = tuple(DETAILS)
RIDGE = 1e-4  # of the least squares, as a share of the features' mean square; a convention
ROUND = 0.1  # weight of the identity in a frame, so that few points do


def _raw(y, mask):
    """The values as they are, but for their size."""
    return y / jnp.maximum(jnp.max(jnp.abs(y)), jnp.finfo(y.dtype).tiny)


def _standard(y, mask):
    n = jnp.maximum(jnp.sum(mask, dtype=y.dtype), 1)
    centred = jnp.where(mask, y - jnp.sum(y) / n, 0)
    return centred / jnp.maximum(jnp.sqrt(jnp.sum(centred**2) / n), jnp.finfo(y.dtype).tiny)


def _rank(y, mask):
    """Normal scores: Phi^-1((r + 1/2) / n) of the rank r from 0; equal values share the mean of
    their ranks.
    """
    n = jnp.maximum(jnp.sum(mask, dtype=y.dtype), 1)
    less = jnp.sum((y[None, :] < y[:, None]) & mask[None, :], axis=1, dtype=y.dtype)
    equal = jnp.sum((y[None, :] == y[:, None]) & mask[None, :], axis=1, dtype=y.dtype)
    return jnp.where(mask, ndtri(jnp.clip((less + 0.5 * equal) / n, 1e-4, 1 - 1e-4)), 0)


WARPS = {"raw": _raw, "standard": _standard, "rank": _rank}


def warp_values(warp, y, mask):
    """(values to model [n], their mask): non-finite ones are left out, but for the ranks, where
    they are the worst.
    """
    finite = mask & jnp.isfinite(y)
    if warp == "rank":
        return _rank(jnp.where(finite, y, jnp.inf), mask), mask
    return WARPS[warp](jnp.where(finite, y, 0), finite), finite


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


def fit(kind, x, y, mask, frame, detail=None):
    """The `Surrogate` of this kind (of `SURROGATES`) for points ``x`` [n, d] with warped values
    ``y`` [n], where ``mask`` [n]; ``detail``: see `DETAILS`.
    """
    detail = DETAILS[kind] if detail is None else detail
    z = jnp.where(mask[:, None], _in_frame(frame, jnp.where(mask[:, None], x, 0)), 0)
    if kind == "gaussian process":
        return Surrogate(
            frame, gaussian_process.fit(z, y, mask, gaussian_process.LENGTHSCALES, kernel=detail)
        )
    features = jnp.where(mask[:, None], BASES[kind](z, z, mask, detail), 0)
    normal = features.T @ features
    # a masked centre is no feature
    live = jnp.maximum(jnp.sum(jnp.diagonal(normal) > 0, dtype=x.dtype), 1)
    ridge = jnp.maximum(RIDGE * jnp.trace(normal) / live, jnp.finfo(x.dtype).tiny) * jnp.eye(
        len(normal), dtype=x.dtype
    )
    weights = cho_solve(cho_factor(normal + ridge), features.T @ jnp.where(mask, y, 0))
    return Surrogate(frame, Basis(z, mask, weights, detail))


def predict(kind, surrogate, x):
    """What the model expects at ``x`` [m, d]: [m], on the scale of the warped values."""
    z = _in_frame(surrogate.frame, x)
    if kind == "gaussian process":
        return gaussian_process.predict(surrogate.model, z)
    model = surrogate.model
    return BASES[kind](z, model.x, model.mask, model.detail) @ model.weights


def lower_bound(kind, surrogate, optimism, x):
    """[m]: the mean less ``optimism`` standard deviations; only a Gaussian process knows any."""
    if kind != "gaussian process":
        return predict(kind, surrogate, x)
    mean, variance = gaussian_process.predict(
        surrogate.model, _in_frame(surrogate.frame, x), variance=True
    )
    return mean - optimism * jnp.sqrt(variance)


def _in_frame(frame, x):
    return solve_triangular(frame.factor, (x - frame.centre[None]).T, lower=True).T
