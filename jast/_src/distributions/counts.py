"""Families of counts: geometric, Poisson, binomial. Their numbers are found by the logs of the
probabilities below and above, so that rare ones come at the right z in both tails.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import lgamma, stop_gradient
from jax.scipy.special import betainc, gammainc, gammaincc, xlog1py

from jast._src.core.typing import Array, Numeric, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.base import Elementwise, parameter_array
from jast._src.distributions.continuous import log_power
from jast._src.distributions.family_table import register
from jast._src.distributions.normal_tails import (
    inside,
    log_one_less,
    log_tails,
    normal_of_log_tails,
)
from jast._src.distributions.tables import REACH, numbers, serves
from jast._src.distributions.tilted import Tilted

__all__ = ["Binomial", "Geometric", "Poisson", "TiltedCounts"]


MAX_EDGES = 8192
"""Numbers of a table on either side of the mean at most: 64 kB in a program."""
LARGE = 200.0
"""Mean from which a Poisson's tails and density are taken by its deviance in float32: they are off
by 2e-5 there, which falls, and its incomplete gamma function by 1e-4, which rises to .1 at 1e5."""
SERIES = tuple(2 * (-1) ** n / (n * (n - 1)) for n in range(9, 1, -1))
"""Of `_deviance`, for polyval."""
SPARE = 64
"""Numbers beyond so many standard deviations that a table has, as tails of few are long."""


def _deviance(t):
    """2 ((1 + t) log(1 + t) - t) / t^2: by its series where the difference would round."""
    t = jnp.maximum(t, jnp.finfo(t.dtype).epsneg - 1)  # of a count that is next to none
    near = jnp.abs(t) < 0.1
    far = jnp.where(near, 1, t)
    whole = 2 * ((1 + far) * jnp.log1p(far) - far) / jnp.square(far)
    return jnp.where(near, jnp.polyval(jnp.asarray(SERIES, t.dtype), jnp.where(near, t, 0)), whole)


class _Counts(Elementwise):
    """0, 1, 2, ... by numbers; a subclass says ``log_tails(k)`` and ``top``; ``_moments`` of its
    numbers, arrays or floats: mean, variance, and the third central moment as a share of that; and
    ``_tails`` of floats, on the host.
    """

    _parameters = ("_parameter",)
    _parameter: Any

    @property
    def dtype(self) -> Any:
        return jnp.zeros((), int).dtype

    def log_tails(self, k: int) -> tuple[Array, Array]:
        """(log P(X <= k), log P(X > k)) for whole k >= -1, as floats."""
        raise NotImplementedError

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        # JAX's own draws of some families are for Threefry's keys alone
        return self._from_normal(
            fine_draws.normal(key, (n, *self.batch_shape), self._parameter.dtype)
        )

    def _from_normal(self, z):
        """The number of which z is a normal number: from a table of where each begins, if
        `tables.serves`.
        """
        known = self._known_numbers
        edges = _edges(type(self), known) if serves(known, z) else None
        if edges is None:
            return self._place(*log_tails(z))
        first, ends = edges
        return (first + jnp.searchsorted(ends, z)).astype(self.dtype)

    def _guess(self, z):
        """About the number of z: Cornish and Fisher 1938, to the second term."""
        mean, variance, skew = self._moments(*(getattr(self, name) for name in self._parameters))
        guess = mean + jnp.sqrt(variance) * z + skew * (z**2 - 1) / 6
        return stop_gradient(jnp.clip(jnp.round(guess), 0, self.top))

    def _place(self, below, above):
        """The least k with P(X <= k) >= exp(below), by whichever of the two is small: from a guess
        in strides that double, then between two that are known.
        """
        below, above, top = map(stop_gradient, (below, above, self.top))
        top = jnp.broadcast_to(top, jnp.shape(below)).astype(below.dtype)

        def between(low, high):
            return jnp.floor((low + high) / 2)

        def go_on(carry):
            low, high, *_ = carry  # which may be neighbours among floats, and far apart
            return jnp.any((between(low, high) > low) & (between(low, high) < high))

        def narrow(carry):
            low, high, k, stride = carry  # P(X <= low) is too little, P(X <= high) is enough
            log_below, log_above = self.log_tails(k)
            enough = jnp.where(below < above, log_below >= below, log_above <= above)
            low, high = jnp.where(enough, low, k), jnp.where(enough, k, high)
            onward = jnp.where(enough, high - stride, low + stride)
            k = jnp.where(stride < high - low, onward, between(low, high))
            return low, high, jnp.clip(k, low, high), 2 * stride

        k = self._guess(normal_of_log_tails(below, above)).astype(below.dtype)
        carry = jnp.full_like(top, -1), top, k, jnp.ones_like(top)
        return jax.lax.while_loop(go_on, narrow, carry)[1].astype(self.dtype)

    def log_cell(self, x: Any) -> Array:
        """(log of P(X < x) + p(x) / 2, log of P(X > x) + p(x) / 2): the middle of x's cell."""
        k = jnp.floor(jnp.asarray(x).astype(self._parameter.dtype))
        half = self._log_p(jnp.maximum(k, 0)) - jnp.log(2.0).astype(k.dtype)
        half = jnp.where(k < 0, -jnp.inf, half)
        below = self.log_tails(jnp.maximum(k - 1, -1))[0]
        above = self.log_tails(jnp.maximum(k, -1))[1]
        return jnp.logaddexp(below, half), jnp.logaddexp(above, half)

    def log_prob(self, value: Any) -> Array:
        k = jnp.asarray(value).astype(self._parameter.dtype)
        whole = (k >= 0) & (k == jnp.floor(k))
        return jnp.where(whole, self._log_p(jnp.where(whole, k, 0)), -jnp.inf)


@functools.lru_cache(maxsize=256)
def _edges(kind, known):
    """(k, the normal numbers up to which k, k + 1, ... reach); None where they would be many."""
    from scipy.special import ndtri

    mean, variance, _ = kind._moments(*known)
    far = REACH * math.sqrt(max(variance, 0)) + SPARE
    if far > MAX_EDGES:
        return None
    k = np.arange(max(math.floor(mean - far), 0), math.ceil(mean + far))
    below, above = kind._tails(*known, k)
    with np.errstate(divide="ignore"):
        return k[0], np.where(below < above, ndtri(below), -ndtri(above)).astype(np.float32)


class Geometric(_Counts):
    """How many failures come before the first success, of probability ``probs``: 0, 1, 2, ...

    Example:
        >>> from jast import distributions as D
        >>> d = D.Geometric(0.5)
        >>> int(d.mode())
        0
    """

    def __init__(self, probs: Numeric) -> None:
        self.probs: jax.Array = parameter_array(f"{self.name}: probs", probs, 0, 1)
        self._parameter = self.probs

    def _place(self, below, above):
        k = jnp.ceil(above / jnp.log1p(-self.probs)) - 1
        return jnp.maximum(k, 0).astype(self.dtype)

    def _log_p(self, k):
        return jnp.log(self.probs) + xlog1py(k, -self.probs)

    def log_tails(self, k: int) -> tuple[Array, Array]:
        above = xlog1py(k + 1, -self.probs)
        return log_one_less(above), above

    def mean(self) -> Any:
        return (1 - self.probs) / self.probs

    def mode(self) -> Any:
        return jnp.zeros(self.batch_shape, self.dtype)


class Poisson(_Counts):
    """Of mean ``rate``.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Poisson(3.5)
        >>> int(d.mode())
        3
    """

    def __init__(self, rate: Numeric) -> None:
        self.rate: jax.Array = parameter_array("Poisson: rate", rate)
        self._parameter, self._known_numbers = self.rate, numbers(rate)

    @property
    def top(self) -> Any:
        return jnp.ceil(self.rate + 40 * jnp.sqrt(self.rate) + 800)  # beyond every float's z

    @staticmethod
    def _moments(rate):
        return rate, rate, 1

    @staticmethod
    def _tails(rate, k):
        from scipy import special

        return special.pdtr(k, rate), special.pdtrc(k, rate)

    @property
    def _large(self):
        """(whether its numbers are of its deviance, a rate for these)."""
        large = (self.rate > LARGE) & (self.rate.dtype == jnp.float32)
        return large, jnp.where(large, self.rate, LARGE)

    def _log_p(self, k):
        """Where the rate is large as Loader 2000 has it, Fast and accurate computation of binomial
        probabilities.
        """
        large, rate = self._large
        many = jnp.maximum(k, 1)
        gap = many - rate
        of_large = -jnp.square(gap) / (2 * rate) * _deviance(gap / rate) - 1 / (12 * many)
        of_large -= jnp.log(2 * math.pi * many) / 2
        exact = log_power(self.rate, k) - self.rate - lgamma(k + 1)
        return jnp.where(large & (k > 0), of_large, exact)

    def log_tails(self, k: int) -> tuple[Array, Array]:
        """Where the rate is large by the normal number of Peizer and Pratt 1968 (Journal of the
        American Statistical Association 63, 1416-1456).
        """
        none, up_to = k < 0, jnp.maximum(k, 0) + 1
        large, rate = self._large
        gap = up_to - rate
        z = (gap - 1 / 3 + 0.02 / up_to) * jnp.sqrt(_deviance((gap - 0.5) / rate) / rate)
        below, above = log_tails(z)
        below = jnp.where(large, below, jnp.log(gammaincc(up_to, self.rate)))
        above = jnp.where(large, above, jnp.log(gammainc(up_to, self.rate)))
        return jnp.where(none, -jnp.inf, below), jnp.where(none, 0.0, above)

    def mean(self) -> Any:
        return self.rate

    def mode(self) -> Any:
        return jnp.floor(self.rate).astype(self.dtype)


class Binomial(_Counts):
    """How many of ``total_count`` trials succeed, each with probability ``probs``.

    In float32 with many trials its numbers are rough: with 200,000 normal numbers are off by up to
    .15 and log densities by .3; with 2000 by a thousandth.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Binomial(10.0, 0.5)
        >>> int(d.mode())
        5
    """

    _parameters = "total_count", "probs"

    def __init__(self, total_count: Numeric, probs: Numeric) -> None:
        self.probs: jax.Array = parameter_array(f"{self.name}: probs", probs, 0, 1)
        self.total_count: jax.Array = jnp.asarray(
            parameter_array("Binomial: total_count", total_count), self.probs.dtype
        )
        self._parameter, self._known_numbers = self.probs, numbers(total_count, probs)

    @property
    def top(self) -> Any:
        return self.total_count

    @staticmethod
    def _moments(n, p):
        return n * p, n * p * (1 - p), 1 - 2 * p

    @staticmethod
    def _tails(n, p, k):
        from scipy import special

        k = np.minimum(k, n)
        return special.bdtr(k, int(n), p), special.bdtrc(k, int(n), p)

    def _log_p(self, k):
        n, p = self.total_count, self.probs
        inner = jnp.minimum(k, n)
        ways = lgamma(n + 1) - lgamma(inner + 1) - lgamma(n - inner + 1)
        log_p = ways + log_power(p, inner) + xlog1py(n - inner, -p)
        return jnp.where(k > n, -jnp.inf, log_p)

    def log_tails(self, k: int) -> tuple[Array, Array]:
        n, p = self.total_count, self.probs
        inner = jnp.clip(k, 0, n - 1)
        below = jnp.log(betainc(n - inner, inner + 1, 1 - p))
        above = jnp.log(betainc(inner + 1, n - inner, p))
        none, all_of = k < 0, k >= n
        below = jnp.where(none, -jnp.inf, jnp.where(all_of, 0.0, below))
        return below, jnp.where(none, 0.0, jnp.where(all_of, -jnp.inf, above))

    def mean(self) -> Any:
        return self.total_count * self.probs

    def mode(self) -> Any:
        k = jnp.floor((self.total_count + 1) * self.probs)
        return jnp.minimum(k, self.total_count).astype(self.dtype)


class TiltedCounts(Tilted):
    """A family of counts with z ~ N(mean, deviation^2): only the probabilities of its numbers
    change. Exact.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.tilted(D.Poisson(3.0), jnp.array(2.0), jnp.array(0.5))
        >>> int(d.sample(seed=0)) > 1
        True
    """

    @property
    def dtype(self) -> Any:
        return self._distribution.dtype

    def _edge(self, k):
        """The z above which numbers are greater than k."""
        below, above = self._distribution.log_tails(k)
        z = normal_of_log_tails(below, above)
        return jnp.where(jnp.isinf(below), -jnp.inf, jnp.where(jnp.isinf(above), jnp.inf, z))

    def log_prob(self, value: Any) -> Array:
        k = jnp.asarray(value).astype(self._mean.dtype)
        edges = (self._edge(v) for v in (jnp.maximum(k - 1, -1), k))
        a, b = ((v - self._mean) / self._deviation for v in edges)
        # in the upper tail from the other side, where the numbers are small
        near, far = jnp.where(a > 0, -a, b), jnp.where(a > 0, -b, a)
        log_near, log_far = log_tails(near)[0], log_tails(far)[0]
        some = (k >= 0) & (k == jnp.floor(k)) & (log_near > -jnp.inf)
        gap = jnp.where(some, log_far - log_near, -1)
        return jnp.where(some, log_near + log_one_less(jnp.minimum(gap, 0)), -jnp.inf)


register(
    _Counts,
    quantile=lambda d, u: d._place(jnp.log(inside(u)), jnp.log1p(-inside(u))),
    cdf=lambda d, x: jnp.exp(d.log_cell(x)[0]),
    from_normal=lambda d, z: d._from_normal(z),
    to_normal=lambda d, x: normal_of_log_tails(*d.log_cell(x)),
    tilt=TiltedCounts,
)
