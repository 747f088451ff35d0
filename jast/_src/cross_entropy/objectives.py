"""Functions to minimise, x [d] -> scalar: sierra, Branin's and Ackley's functions (Kochenderfer and
Wheeler 2019, appendix B), a paraboloid.

Each works in the dtype of x, under jit, vmap and grad, and raises ValueError for an x of another
shape.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp
from jax.tree_util import Partial

from jast._src.core.typing import Array, Numeric, Objective
from jast._src.cross_entropy.gaussian import widest_float
from jast._src.runtime._jax import is_traced
from jast._src.util.checks import real_number, truth_value, wrong

__all__ = ["ackley", "branin", "paraboloid", "sierra"]

_CORNERS = np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)])  # g of the source, in spacings
_PATHS = {  # p of the source; the i-th has covariance i^decay Sigma / eta, so their order matters
    "code": np.array([(0, 0), (1, 1), (2, 0), (3, 1), (0, 2), (1, 3)]),
    "thesis": np.array([(0, 0), (1, 1), (2, 0), (0, 2), (3, 1), (1, 3)]),
}


def sierra(
    mean: Array | Sequence[float] = (0.0, 0.0),
    variance: Numeric = 3.0,
    spacing: Numeric = 2.0,
    sharpness: Numeric = 6.0,
    decay: Numeric = 1.0,
    order: Literal["code", "thesis"] = "code",
    log: bool = False,
) -> Objective:
    """Less the density of 49 Gaussians of equal weight: a mountain range upside down, for
    optimisers (chapter 2 of R. J. Moss's thesis).

    The central Gaussian has covariance I / ``sharpness`` about ``mean``. Around it are four
    corners, (+-spacing, +-spacing). Of each, six components go out both ways, p in (0,0), (1,1),
    (2,0), (3,1), (0,2), (1,3), to mean + corner +- variance p, the i-th of covariance i^decay
    variance / sharpness I.

    With the default settings there are 17 minima: -0.0220023684 at 0 (the next is -0.0154475), or
    -0.0219510551 with the thesis's order.

    Args:
        mean: [2]: mu of the thesis. The dtype is that of the float arrays given, the wider one,
            else the default; the value's is that of x.
        variance: sigma, and the length of a path's step too.
        spacing: delta.
        sharpness: eta.
        decay: see above.
        order: "thesis" has (3,1) and (0,2) in each other's place, as printed; "code" is that of the
            published code.
        log: return less the log of the density: the same order of values, so the same minima, and
            it does not underflow. Use it where values are only compared, above all in float32, in
            which sierra itself is 0 from about 23 away from all its centres.

    Returns:
        A `jax.tree_util.Partial` of x [2] that binds the components: the settings are traced, and
        another sierra is no new program. Every setting but the last two may be traced.

    Raises:
        ValueError: for a mean that is not two finite numbers, a variance or sharpness that is not
            positive, and an unknown order.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> round(float(ce.sierra()(jnp.zeros(2))), 4)
        -0.022
    """
    if order not in _PATHS:
        raise ValueError(f'sierra: order must be "code" or "thesis", received {order!r}')
    truth_value("sierra", log=log)
    try:
        given = jnp.asarray(mean) if is_traced(mean) else np.asarray(mean, float)
        good = given.shape == (2,) and (is_traced(mean) or np.isfinite(given).all())
    except (TypeError, ValueError):  # no numbers, or rows of different lengths
        good = False
    if not good:
        raise ValueError(f"sierra: mean must be 2 finite numbers, received {mean!r}")
    for name, value in dict(variance=variance, sharpness=sharpness).items():
        real_number("sierra", name, value, lambda v: 0 < v < math.inf, "above 0")
    for name, value in dict(spacing=spacing, decay=decay).items():
        real_number("sierra", name, value, math.isfinite, "that is finite")
    given = (mean, variance, spacing, sharpness, decay)
    dtype = widest_float(*given)
    mean, variance, spacing, sharpness, decay = (jnp.asarray(v).astype(dtype) for v in given)

    corners = jnp.asarray(_CORNERS[:, None, None], dtype)  # [corner, path, way, coordinate]
    paths = jnp.asarray(_PATHS[order][None, :, None], dtype)
    ways = jnp.asarray(np.array([1, -1])[None, None, :, None], dtype)
    around = (spacing * corners + variance * ways * paths).reshape(-1, 2)
    fading = jnp.arange(1, 7, dtype=dtype)[None, :, None] ** decay
    spread = jnp.broadcast_to(fading, (4, 6, 2)).ravel() * variance / sharpness
    means = jnp.concatenate([mean[None], mean[None] + around])
    variances = jnp.concatenate([1 / sharpness[None], spread])  # Sigma / (sigma eta) = I / eta
    return Partial(_log_sierra if log else _sierra, means, variances)


def _sierra(means, variances, x):
    """-(1/49) sum of densities."""
    return -jnp.exp(-_log_sierra(means, variances, x))


def _log_sierra(means, variances, x):
    """-log of the mean of the densities of N(means [k, 2], variances [k] I)."""
    x = _vector("sierra", x, 2)
    means, variances = means.astype(x.dtype), variances.astype(x.dtype)
    r2 = jnp.sum((x[None] - means) ** 2, axis=1)
    log_densities = -0.5 * r2 / variances - jnp.log(2 * math.pi * variances)
    return math.log(means.shape[0]) - logsumexp(log_densities)


def branin(x: Array) -> Array:
    """Branin's function: (x2 - 5.1 x1^2 / (4 pi^2) + 5 x1 / pi - 6)^2 + 10 (1 - 1 / (8 pi)) cos x1
    + 10.

    Usually on [-5, 10] x [0, 15]. Three minima of 5 / (4 pi) = 0.397887: (-pi, 12.275), (pi, 2.275)
    and (3 pi, 2.475).

    Args:
        x: [2].

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> round(float(ce.branin(jnp.array([jnp.pi, 2.275]))), 4)
        0.3979
    """
    x1, x2 = _vector("branin", x, 2)
    valley = (x2 - 5.1 / (4 * math.pi**2) * x1**2 + 5 / math.pi * x1 - 6) ** 2
    return valley + 10 * (1 - 1 / (8 * math.pi)) * jnp.cos(x1) + 10


def ackley(x: Array) -> Array:
    """Ackley's function: 20 - 20 exp(-0.2 sqrt(mean x_i^2)) + e - exp(mean cos(2 pi x_i)).

    Its least value is 0, at 0, where it is not differentiable (the gradient is given as 0). There
    is a local minimum near every point of whole numbers.

    Args:
        x: [d].

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> abs(float(ce.ackley(jnp.zeros(2)))) < 1e-5
        True
    """
    x = _vector("ackley", x)
    r2 = jnp.mean(x**2)
    # the square root has no derivative at 0
    r = jnp.where(r2 > 0, jnp.sqrt(jnp.where(r2 > 0, r2, 1)), 0)
    # cos(2 a) - 1 = -2 sin(a)^2 and expm1: no cancellation near the minimum
    return -20 * jnp.expm1(-0.2 * r) - math.e * jnp.expm1(-2 * jnp.mean(jnp.sin(math.pi * x) ** 2))


def paraboloid(x: Array) -> Array:
    """The sum of squares; 0 at 0.

    Args:
        x: [d].

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import cross_entropy as ce
        >>> float(ce.paraboloid(jnp.array([3.0, 4.0])))
        25.0
    """
    return jnp.sum(_vector("paraboloid", x) ** 2)


def _vector(function, x, d=None):
    """``x`` as a vector of floats, of ``d`` numbers where d is given."""
    x = jnp.asarray(x)
    if x.ndim != 1 or x.size == 0 or d not in (None, x.size):
        must = f"be a vector of {d or 'one or more'} numbers"
        raise wrong(function, "x", must, f"shape {x.shape}; for more points use jax.vmap")
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(jnp.zeros(()).dtype)
