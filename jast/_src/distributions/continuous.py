"""Families of floats beside the normal ones. Draws and log densities of those that distrax has,
too, agree with its to the bit.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
from jax.lax import lgamma

from jast._src.core.typing import Array, ArrayTree, Numeric, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.base import Elementwise, broadcast, float_array, parameter_array
from jast._src.distributions.normal import Symmetric
from jast._src.distributions.tables import numbers

__all__ = ["Beta", "Gamma", "Laplace", "Logistic", "Uniform", "log_power"]


class Laplace(Symmetric):
    """Density exp(-|x - loc| / scale) / (2 scale).

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.Laplace(0.0, 0.5)
        >>> float(jnp.exp(d.log_prob(0.0)))
        1.0
    """

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return self.loc[None] + self.scale[None] * fine_draws.laplace(key, **self._like_n(n))

    def log_prob(self, value: Any) -> Array:
        return -jnp.abs(self._standardize(value)) - math.log(2.0) - jnp.log(self._scale)

    def stddev(self) -> Any:
        return math.sqrt(2.0) * self.scale

    def variance(self) -> Any:
        return 2.0 * jnp.square(self.scale)


class Logistic(Symmetric):
    """Distribution function 1 / (1 + exp(-(x - loc) / scale)).

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.Logistic(0.0, 1.0)
        >>> float(D.cdf(d, jnp.array(0.0)))
        0.5
    """

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return self._placed(fine_draws.logistic(key, **self._like_n(n)))

    def log_prob(self, value: Any) -> Array:
        v = self._standardize(value)
        return -v - 2.0 * jax.nn.softplus(-v) - jnp.log(self._scale)

    def stddev(self) -> Any:
        return self.scale * math.pi / math.sqrt(3.0)

    def variance(self) -> Any:
        return jnp.square(self.stddev())


class Uniform(Elementwise):
    """On [``low``, ``high``], which broadcast.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Uniform(-1.0, 3.0)
        >>> float(d.mean())
        1.0
    """

    _parameters = "_low", "_high"
    low: jax.Array = broadcast("_low")
    high: jax.Array = broadcast("_high")

    def __init__(self, low: ArrayTree = 0.0, high: ArrayTree = 1.0) -> None:
        self._low = float_array(low)
        self._high = parameter_array("Uniform: high", high, self._low)

    @property
    def range(self) -> jax.Array:
        return self.high - self.low

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        u = fine_draws.uniform(key, (n, *self.batch_shape), self.range.dtype)
        return self.low[None] + self.range[None] * u

    def prob(self, value: Any) -> Array:
        outside = (value < self.low) | (value > self.high)
        return jnp.where(outside, jnp.zeros_like(value), jnp.ones_like(value) / self.range)

    def log_prob(self, value: Any) -> Array:
        return jnp.log(self.prob(value))

    def mean(self) -> Any:
        return (self.low + self.high) / 2.0

    median = mean

    def stddev(self) -> Any:
        return self.range / math.sqrt(12.0)

    def variance(self) -> Any:
        return jnp.square(self.range) / 12.0


def log_power(x: Array, k: Array) -> Array:
    """The log of x^k, which is 0 for k = 0 at x = 0, too; -inf for x < 0, outside of a support."""
    outside, zero = x < 0, k == 0
    x = jnp.where(zero & (x == 0), 1, jnp.where(outside, jnp.where(k < 0, jnp.inf, 0), x))
    # last of all the product: what is added to it then rounds as in other libraries
    return jnp.where(zero & outside, 1, k) * jnp.log(x)


class _Pair(Elementwise):
    """Of two positive parameters that broadcast."""

    _parameters = "_a", "_b"
    _words: tuple[str, str]

    def __init__(self, a: Numeric, b: Numeric) -> None:
        self._a: jax.Array = parameter_array(f"{self.name}: {self._words[0]}", a)
        self._b: jax.Array = parameter_array(f"{self.name}: {self._words[1]}", b)
        self._known_numbers = numbers(a, b)


class Gamma(_Pair):
    """Density proportional to x^(concentration - 1) exp(-rate x), x > 0.

    Example:
        >>> from jast import distributions as D
        >>> d = D.Gamma(2.0, 4.0)
        >>> float(d.mean())
        0.5
    """

    _words = "concentration", "rate"

    def __init__(self, concentration: Numeric, rate: Numeric) -> None:
        super().__init__(concentration, rate)

    concentration: jax.Array = broadcast("_a")
    rate: jax.Array = broadcast("_b")

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        a = self.concentration
        return jax.random.gamma(key, a, (n, *a.shape), self.dtype) / self.rate[None]

    def log_prob(self, value: Any) -> Array:
        a, rate = self._a, self._b
        return a * jnp.log(rate) + log_power(value, a - 1) - rate * value - lgamma(a)

    def mean(self) -> Any:
        return self._a / self._b

    def variance(self) -> Any:
        return self._a / jnp.square(self._b)

    def stddev(self) -> Any:
        return jnp.sqrt(self._a) / self._b

    def mode(self) -> Any:
        """(concentration - 1) / rate; NaN where the density has no maximum."""
        return jnp.where(self._a >= 1.0, (self._a - 1.0) / self._b, jnp.nan)


class Beta(_Pair):
    """Density proportional to x^(alpha - 1) (1 - x)^(beta - 1) on [0, 1].

    Example:
        >>> from jast import distributions as D
        >>> d = D.Beta(2.0, 2.0)
        >>> float(d.mean())
        0.5
    """

    _words = "alpha", "beta"

    def __init__(self, alpha: Numeric, beta: Numeric) -> None:
        super().__init__(alpha, beta)
        self._norm = lgamma(self._a) + lgamma(self._b) - lgamma(self._a + self._b)

    alpha: jax.Array = broadcast("_a")
    beta: jax.Array = broadcast("_b")

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        shape = (n, *self.batch_shape)
        return jax.random.beta(key, self.alpha, self.beta, shape, self.dtype)

    def log_prob(self, value: Any) -> Array:
        a, b = self._a, self._b
        return log_power(value, a - 1.0) + log_power(1.0 - value, b - 1.0) - self._norm

    def mean(self) -> Any:
        return self._a / (self._a + self._b)

    def variance(self) -> Any:
        total = self._a + self._b
        return self._a * self._b / (jnp.square(total) * (total + 1.0))

    def stddev(self) -> Any:
        return jnp.sqrt(self.variance())

    def mode(self) -> Any:
        """NaN where the density has no single maximum."""
        a, b = self._a, self._b
        inner = (a - 1.0) / (a + b - 2.0)
        at_end = jnp.where(
            (a <= 1.0) & (b > 1.0), 0.0, jnp.where((a > 1.0) & (b <= 1.0), 1.0, jnp.nan)
        )
        return jnp.where((a > 1.0) & (b > 1.0), inner, at_end)
