"""Skewed families with closed quantiles, exact in both tails: each a class and one row, by the logs
of the probabilities below and above a value.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp

from jast._src.core.typing import Array, ArrayTree, Numeric, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.base import Elementwise, broadcast, float_array, parameter_array
from jast._src.distributions.continuous import log_power
from jast._src.distributions.family_table import register, register_both
from jast._src.distributions.log_tail_rows import of_log_tails
from jast._src.distributions.normal import LocationScale
from jast._src.distributions.normal_tails import (
    HALF_LOG_2PI,
    inside,
    log_one_less,
    log_tails,
    ndtr,
    ndtri,
    normal_of_log_tails,
)

__all__ = ["Exponential", "Gumbel", "LogNormal", "TruncatedNormal", "Weibull"]


class LogNormal(LocationScale):
    """exp(e), e normal with mean ``loc`` and standard deviation ``scale``.

    Example:
        >>> from jast import distributions as D
        >>> d = D.LogNormal(0.0, 1.0)
        >>> float(d.median())
        1.0
    """

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return jnp.exp(self._placed(fine_draws.normal(key, **self._like_n(n))))

    def log_prob(self, value: Any) -> Array:
        possible = value > 0
        log = jnp.log(jnp.where(possible, value, 1))
        density = -0.5 * jnp.square(self._standardize(log)) - HALF_LOG_2PI - jnp.log(self._scale)
        return jnp.where(possible, density - log, -jnp.inf)

    def mean(self) -> Any:
        return jnp.exp(self.loc + jnp.square(self.scale) / 2)

    def median(self) -> Any:
        return jnp.exp(self.loc)

    def mode(self) -> Any:
        return jnp.exp(self.loc - jnp.square(self.scale))


register(
    LogNormal,
    quantile=lambda d, u: jnp.exp(d.loc + d.scale * ndtri(inside(u))),
    cdf=lambda d, x: ndtr((jnp.log(jnp.maximum(x, 0)) - d.loc) / d.scale),
    from_normal=lambda d, z: jnp.exp(d.loc + d.scale * z),
    to_normal=lambda d, x: (jnp.log(jnp.maximum(x, 0)) - d.loc) / d.scale,
    tilt=lambda d, m, s: LogNormal(d.loc + d.scale * m, d.scale * s),
)


class Exponential(Elementwise):
    """Density rate exp(-rate x), x >= 0.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Exponential(2.0)
        >>> float(d.mean())
        0.5
    """

    _parameters = ("rate",)

    def __init__(self, rate: Numeric) -> None:
        self.rate: jax.Array = parameter_array("Exponential: rate", rate)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return fine_draws.exponential(key, (n, *self.rate.shape), self.rate.dtype) / self.rate[None]

    def log_prob(self, value: Any) -> Array:
        return jnp.where(value < 0, -jnp.inf, jnp.log(self.rate) - self.rate * value)

    def mean(self) -> Any:
        return 1 / self.rate

    def mode(self) -> Any:
        return jnp.zeros_like(self.rate)


def _tails_exponential(d, x):
    above = -d.rate * jnp.maximum(x, 0)
    return log_one_less(above), above


register(Exponential, **of_log_tails(lambda d, below, above: -above / d.rate, _tails_exponential))


class Gumbel(LocationScale):
    """Of the largest of many numbers: distribution function exp(-exp(-(x - loc) / scale)).

    Example:
        >>> from jast import distributions as D
        >>> d = D.Gumbel(1.0, 2.0)
        >>> float(d.mode())
        1.0
    """

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return self._placed(fine_draws.gumbel(key, **self._like_n(n)))

    def log_prob(self, value: Any) -> Array:
        v = self._standardize(value)
        return -(v + jnp.exp(-v)) - jnp.log(self._scale)

    def mean(self) -> Any:
        return self.loc + self.scale * jnp.euler_gamma

    def mode(self) -> Any:
        return self.loc


def _tails_gumbel(d, x):
    below = -jnp.exp(-(x - d.loc) / d.scale)
    return below, log_one_less(below)


register_both(
    Gumbel,
    **of_log_tails(lambda d, below, above: d.loc - d.scale * jnp.log(-below), _tails_gumbel),
)


class Weibull(Elementwise):
    """Survival function exp(-(x / scale)^concentration), x >= 0.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.Weibull(1.0, 2.0)
        >>> round(float(D.cdf(d, jnp.array(2.0))), 3)  # 1 - 1 / e
        0.632
    """

    _parameters = "_shape", "_scale"
    concentration: jax.Array = broadcast("_shape")
    scale: jax.Array = broadcast("_scale")

    def __init__(self, concentration: Numeric, scale: Numeric) -> None:
        self._shape = parameter_array("Weibull: concentration", concentration)
        self._scale = parameter_array("Weibull: scale", scale)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        k, scale = self.concentration, self.scale
        e = fine_draws.exponential(key, (n, *k.shape), jnp.result_type(k, scale))
        return scale[None] * e ** (1 / k[None])

    def log_prob(self, value: Any) -> Array:
        k, v = self._shape, value / self._scale
        inner = jnp.log(k / self._scale) + log_power(jnp.abs(v), k - 1) - jnp.abs(v) ** k
        return jnp.where(v < 0, -jnp.inf, inner)

    def mode(self) -> Any:
        """The median where the density has no maximum: for a concentration below 1."""
        k = self.concentration
        power = jnp.where(k < 1, math.log(2.0), jnp.maximum(1 - 1 / k, 0)) ** (1 / k)
        return self.scale * power


def _tails_weibull(d, x):
    above = -((jnp.maximum(x, 0) / d.scale) ** d.concentration)
    return log_one_less(above), above


register(
    Weibull,
    **of_log_tails(
        lambda d, below, above: d.scale * (-above) ** (1 / d.concentration), _tails_weibull
    ),
)


class TruncatedNormal(LocationScale):
    """Normal numbers (``loc``, ``scale`` before the cut) between ``low`` and ``high``, of which
    either may be infinite.

    Example:
        >>> from jast import distributions as D
        >>> d = D.TruncatedNormal(0.0, 1.0, 0.5, 2.0)
        >>> 0.5 <= float(d.sample(seed=0)) <= 2.0
        True
    """

    _parameters = "_loc", "_scale", "_low", "_high"
    low: jax.Array = broadcast("_low")
    high: jax.Array = broadcast("_high")

    def __init__(self, loc: Numeric, scale: Numeric, low: ArrayTree, high: ArrayTree) -> None:
        super().__init__(loc, scale)
        self._low = float_array(low)
        self._high = parameter_array("TruncatedNormal: high", high, self._low)

    def ends(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """(low, high) in standard deviations from loc, and the log of the mass between them."""
        a, b = ((v - self.loc) / self.scale for v in (self.low, self.high))
        # where both are above loc by their upper tails, where the numbers are small
        near, far = jnp.where(a > 0, -a, b), jnp.where(a > 0, -b, a)
        below, above = log_tails(near)[0], log_tails(far)[0]
        return a, b, below + log_one_less(jnp.minimum(above - below, 0))

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        z = fine_draws.normal(key, **self._like_n(n))
        return jax.vmap(lambda z: _cut(self, *log_tails(z)))(z)

    def log_prob(self, value: Any) -> Array:
        exponent = -0.5 * jnp.square(self._standardize(value))
        log_p = exponent - HALF_LOG_2PI - jnp.log(self._scale) - self.ends()[2]
        return jnp.where((value < self._low) | (value > self._high), -jnp.inf, log_p)

    def mode(self) -> Any:
        return jnp.clip(self.loc, self.low, self.high)


def _cut(d, below, above):
    a, b, log_mass = d.ends()
    e = normal_of_log_tails(
        jnp.logaddexp(log_tails(a)[0], log_mass + below),
        jnp.logaddexp(log_tails(b)[1], log_mass + above),
    )
    x = jnp.clip(d.loc + d.scale * e, d.low, d.high)

    def from_end(end, log_part):
        """The way from an end, |z| = ``end`` towards the mean, with a small part of the mass: what
        the sum above rounds away. By the series of the inverse.
        """
        finite = jnp.isfinite(end)
        end = jnp.where(finite, end, 0)
        h = jnp.exp(jnp.minimum(log_mass + log_part + end**2 / 2 + HALF_LOG_2PI, 0))
        small = finite & (h * (1 + jnp.abs(end)) < 1e-3)
        h = jnp.where(small, h, 0)
        return small, d.scale * h * (1 + end * h / 2 + (2 * end**2 + 1) * h**2 / 6)

    at_low, step = from_end(a, below)
    x = jnp.where(at_low, d.low + step, x)
    at_high, step = from_end(-b, above)
    return jnp.where(at_high, d.high - step, x)


def _tails_cut(d, x):
    a, b, log_mass = d.ends()
    e = (jnp.clip(x, d.low, d.high) - d.loc) / d.scale
    left = TruncatedNormal(0.0, 1.0, a, e).ends()[2]
    right = TruncatedNormal(0.0, 1.0, e, b).ends()[2]
    return left - log_mass, right - log_mass


register(TruncatedNormal, **of_log_tails(_cut, _tails_cut))
