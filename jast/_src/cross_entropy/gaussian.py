"""The multivariate normal distribution as a cross-entropy method needs it: drawn from, scored, and
refitted to weighted samples.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import Precision
from jax.scipy.linalg import solve_triangular

from jast._src.core.typing import Array, Numeric
from jast._src.runtime._jax import is_traced
from jast._src.util import display
from jast._src.util.checks import wrong
from jast._src.util.pytrees import select

__all__ = [
    "Gaussian",
    "as_gaussian",
    "check_covariance",
    "finite_array",
    "fit",
    "is_definite",
    "log_prob",
    "moments",
    "normal",
    "sample",
    "widest_float",
]


@display.printable()
class Gaussian(NamedTuple):
    """N(mean, covariance), floats; the covariance is positive definite.

    Example:
        >>> import jax, jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> wide = ce.Gaussian(jnp.ones(2), 4.0 * jnp.eye(2))
        >>> found = ce.ce_method(jax.random.key(0), ce.paraboloid, wide)
        >>> bool(found.proposal.covariance[0, 0] < wide.covariance[0, 0])
        True
    """

    mean: Array
    """[d]"""
    covariance: Array
    """[d, d]"""


def normal(mean: Array, covariance: Numeric) -> Gaussian:
    """A normal distribution of vectors, as a proposal. The dtype is that of the float arrays given,
    the wider one, else the default.

    Args:
        mean: [d].
        covariance: a number (times the identity), the variances [d], or a matrix [d, d].

    Returns:
        `Gaussian`.

    Raises:
        ValueError: unless both are finite and the matrix symmetric and positive definite; of traced
            values only the shapes are looked at.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> ce.normal(jnp.zeros(2), 4.0).covariance.tolist()
        [[4.0, 0.0], [0.0, 4.0]]
    """
    return _normal("normal", mean, covariance)


def as_gaussian(proposal: Any) -> Gaussian:
    """The `Gaussian` that is meant by one, by a pair (mean, covariance), or by a distribution with
    ``mean()`` and ``covariance()``, as distrax's are.

    Raises ValueError, naming ``proposal``, for anything else and for what `normal` refuses.
    """
    if isinstance(proposal, tuple | list) and len(proposal) == 2:
        return _normal("proposal", *proposal)
    if all(callable(getattr(proposal, name, None)) for name in ("mean", "covariance")):
        return _normal("proposal", proposal.mean(), proposal.covariance())
    raise ValueError(
        "proposal: expected a Gaussian, a pair (mean, covariance), or a distribution with mean()"
        f" and covariance(), received {proposal!r}"
    )


def _normal(name, mean, covariance):
    dtype = widest_float(mean, covariance)
    m, c = (
        jnp.asarray(value) if is_traced(value) else finite_array(name, part, value, dtype)
        for part, value in (("mean", mean), ("covariance", covariance))
    )
    if m.ndim != 1 or m.size == 0:
        raise wrong(name, "mean", "be a vector of one or more numbers", f"shape {m.shape}")
    d = m.size
    if c.shape not in ((), (d,), (d, d)):
        must = f"be a number, {d} variances or a {d} x {d} matrix"
        raise wrong(name, "covariance", must, f"shape {c.shape}")
    if not is_traced(covariance):
        check_covariance(name, c)
    m, c = jnp.asarray(m, dtype), jnp.asarray(c, dtype)
    return Gaussian(m, c if c.ndim == 2 else jnp.diag(jnp.broadcast_to(c, (d,))))


def widest_float(*values):
    """The float dtype of these arrays, the widest, as far as JAX has it; the default where none is
    of floats.
    """
    floats = [
        v.dtype for v in values if hasattr(v, "dtype") and jnp.issubdtype(v.dtype, jnp.floating)
    ]
    widest = max(floats, key=lambda t: t.itemsize, default=jnp.zeros(()).dtype)
    return jax.dtypes.canonicalize_dtype(widest)


def finite_array(name, part, value, dtype):
    """``value`` on the host, in the dtype in which it will be used; ValueError unless it is finite
    there.
    """
    try:
        with np.errstate(over="ignore", under="ignore"):
            array = np.asarray(value, np.float64).astype(dtype)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: {part} must be numbers, received {value!r}") from None
    if not np.isfinite(array).all():
        raise wrong(name, part, f"be finite in {np.dtype(dtype).name}", value)
    return array


def check_covariance(name, c):
    """ValueError unless the number, variances or matrix ``c`` is a covariance, on the host."""
    eps, c = float(jnp.finfo(c.dtype).eps), c.astype(np.float64)
    if c.ndim < 2:
        if not (c > 0).all():
            raise ValueError(f"{name}: covariance must be positive, received {c}")
        return
    spread = np.sqrt(np.abs(np.diagonal(c)))
    if not (np.abs(c - c.T) <= 16 * eps * np.outer(spread, spread)).all():
        raise ValueError(f"{name}: covariance must be symmetric, received\n{c}")
    if not (
        (np.diagonal(c) > 0).all()
        and np.linalg.eigvalsh(c / np.outer(spread, spread))[0] > 4 * len(c) * eps
    ):
        raise ValueError(f"{name}: covariance must be positive definite, received\n{c}")


def sample(key: jax.Array, g: Gaussian, n: int) -> jax.Array:
    """``n`` draws [n, d]: mean + L z, L the Cholesky factor of the covariance."""
    z = jax.random.normal(key, (n, *g.mean.shape), g.mean.dtype)
    factor = jnp.linalg.cholesky(g.covariance)
    return g.mean[None] + jnp.matmul(z, factor.T, precision=Precision.HIGHEST)


def log_prob(g: Gaussian, x: jax.Array) -> jax.Array:
    """Log density [...] at ``x`` [..., d]."""
    factor = jnp.linalg.cholesky(g.covariance)
    rows = x.reshape(-1, x.shape[-1]) - g.mean[None]
    z = solve_triangular(factor, rows.T, lower=True)
    constant = 0.5 * x.shape[-1] * math.log(2 * math.pi) + jnp.sum(jnp.log(jnp.diagonal(factor)))
    return (-0.5 * jnp.sum(z**2, axis=0) - constant).reshape(x.shape[:-1])


def fit(g: Gaussian, x: jax.Array, weights: jax.Array) -> Gaussian:
    """The `Gaussian` of greatest likelihood for ``x`` [n, d] with ``weights`` [n], at least 0: the
    covariance is divided by their sum.

    The old ``g`` stays where that has no answer: total weight 0, at most d rows of positive weight,
    a covariance that `is_definite` refuses, a number that is not finite. Rows of weight 0 may hold
    anything, NaN too. Only the weights' ratios matter.
    """
    n, d = x.shape
    if n == 0:
        return g
    weights = weights.astype(x.dtype)
    counted = weights > 0
    w = jnp.where(counted, weights, 0)
    w = w / jnp.max(w)  # neither overflows nor underflows; NaN if all are 0
    w = w / jnp.sum(w)
    mean, covariance = moments(jnp.where(counted[:, None], x, 0), w)
    good = jnp.all(jnp.isfinite(mean)) & is_definite(covariance, mean, n) & (jnp.sum(counted) > d)
    return select(good, Gaussian(mean, covariance), g)


def moments(x: jax.Array, w: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean [d] and covariance [d, d] of ``x`` [n, d] with weights ``w`` [n] that sum to 1."""

    def average(a):
        return jnp.matmul(w, a, precision=Precision.HIGHEST)

    mean = average(x)
    # The mean is rounded relative to its own size, which may be far above the spread: the second
    # pass takes the remainder out
    c = x - mean[None]
    rest = average(c)
    c = c - rest[None]
    covariance = jnp.einsum("n,nd,ne->de", w, c, c, precision=Precision.HIGHEST)
    return mean + rest, 0.5 * (covariance + covariance.T)


def is_definite(covariance, mean, rows):
    """Whether the covariance [d, d] of ``rows`` samples about ``mean`` [d] is positive definite
    beyond its rounding errors; False if it is not finite.

    No standard deviation may be below 4 eps times the mean, about which samples are stored no
    finer. For the rest the correlation matrix R = L L^T is judged, so units do not matter. A
    singular R comes out with a least eigenvalue of the size of rounding errors, and often with a
    Cholesky factor whose pivots look sound, when it is ill-conditioned before the last one. So the
    trace of R^-1, the sum of the inverse eigenvalues and of the squares of L^-1, is asked to be
    below 1 / (4 (d + sqrt(rows)) eps).
    """
    d, eps = covariance.shape[-1], float(jnp.finfo(covariance.dtype).eps)
    spread = jnp.sqrt(jnp.diagonal(covariance))
    correlation = covariance / spread[:, None] / spread[None, :]
    factor = jnp.linalg.cholesky(correlation)
    inverse = solve_triangular(factor, jnp.eye(d, dtype=covariance.dtype), lower=True)
    sound = jnp.sum(inverse**2) * (4 * (d + math.sqrt(rows)) * eps) < 1  # False for NaN
    return sound & jnp.all(spread > 4 * eps * jnp.abs(mean))
