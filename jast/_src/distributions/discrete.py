"""Families of whole numbers. Draws and log densities of those that distrax has, too, agree with its
to the bit.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jast._src.core.typing import Array, Numeric, PRNGKey
from jast._src.distributions import fine_draws
from jast._src.distributions.base import Distribution, float_array, parameter_array

__all__ = ["Bernoulli", "Categorical"]


class _Choice(Distribution):
    """Given by ``probs`` or by ``logits``, in whatever form: one of the two."""

    event_shape: Any = ()
    _logits: Any
    _probs: Any
    _dtype: Any

    def _check(self, logits, probs, dtype, *kinds):
        if (logits is None) == (probs is None):
            raise ValueError(
                f"{self.name}: expected one of logits and probs, received"
                f" {'neither' if probs is None else 'both'}"
            )
        if not any(jnp.issubdtype(dtype, kind) for kind in kinds):
            raise ValueError(f"{self.name}: dtype: expected whole numbers or floats, got {dtype}")
        self._dtype = dtype

    @property
    def _given(self):
        return self._probs if self._logits is None else self._logits

    @property
    def dtype(self) -> Any:
        return jax.dtypes.canonicalize_dtype(self._dtype)


class Bernoulli(_Choice):
    """1 with probability ``probs`` = sigmoid(``logits``), else 0, as ``dtype``.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.Bernoulli(probs=0.25)
        >>> float(jnp.exp(d.log_prob(1)))
        0.25
    """

    def __init__(
        self,
        logits: Numeric | None = None,
        probs: Numeric | None = None,
        dtype: Any = int,
    ) -> None:
        self._check(logits, probs, dtype, jnp.bool_, jnp.integer, jnp.floating)
        self._probs = None if probs is None else parameter_array("Bernoulli: probs", probs, 0, 1)
        self._logits = None if logits is None else float_array(logits)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self._given.shape

    @property
    def probs(self) -> jax.Array:
        return jax.nn.sigmoid(self._logits) if self._probs is None else self._probs

    @property
    def logits(self) -> jax.Array:
        if self._logits is not None:
            return self._logits
        return jnp.log(self._probs) - jnp.log(1 - self._probs)

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        return fine_draws.bernoulli(key, self.probs, n).astype(self._dtype)

    def log_prob(self, value: Any) -> Array:
        if self._logits is None:
            log_0, log_1 = jnp.log1p(-1.0 * self._probs), jnp.log(self._probs)
        else:
            log_0, log_1 = -jax.nn.softplus(self._logits), -jax.nn.softplus(-1.0 * self._logits)
        one = jnp.asarray(value).astype(log_1.dtype)
        log_p = _times(log_0, 1 - one) + _times(log_1, one)
        return jnp.where((one == 0) | (one == 1), log_p, -jnp.inf)

    def mean(self) -> Any:
        return self.probs

    def variance(self) -> Any:
        return (1 - self.probs) * self.probs

    def mode(self) -> Any:
        return (self.probs > 0.5).astype(self._dtype)


class Categorical(_Choice):
    """i = 0 .. k - 1 with probabilities proportional to ``probs`` [..., k] = exp(``logits``), as
    ``dtype``.

    Example:
        >>> import jax.numpy as jnp
        >>> from jast import distributions as D
        >>> d = D.Categorical(probs=jnp.array([1.0, 3.0]))
        >>> int(d.mode())
        1
    """

    def __init__(
        self, logits: Array | None = None, probs: Array | None = None, dtype: Any = int
    ) -> None:
        self._check(logits, probs, dtype, jnp.integer, jnp.floating)
        self._logits = self._probs = None
        if logits is None:
            probs = jnp.asarray(probs)
            probs = probs.astype(float) if probs.dtype == bool else probs
            probs = parameter_array("Categorical: probs", probs)
            self._probs = probs / probs.sum(axis=-1, keepdims=True)
        else:
            self._logits = jax.nn.log_softmax(jnp.asarray(logits), axis=-1)

    @property
    def batch_shape(self) -> tuple[int, ...]:
        return self._given.shape[:-1]

    @property
    def probs(self) -> jax.Array:
        return jax.nn.softmax(self._logits, axis=-1) if self._probs is None else self._probs

    @property
    def logits(self) -> jax.Array:
        return jnp.log(self._probs) if self._logits is None else self._logits

    @property
    def num_categories(self) -> int:
        return self._given.shape[-1]

    def _sample_n(self, key: PRNGKey, n: int) -> Any:
        logits, p = self.logits, self.probs
        valid = jnp.all(jnp.isfinite(p), axis=-1) & jnp.all(p >= 0, axis=-1)
        draws = fine_draws.categorical(key, logits, n).astype(self._dtype)
        return jnp.where(valid[None], draws, jnp.ones_like(draws) * -1)

    def log_prob(self, value: Any) -> Array:
        logits, k = self.logits, self.num_categories
        chosen = jax.nn.one_hot(value, k, dtype=logits.dtype)
        outside = (value < 0) | (value > k - 1)
        return jnp.where(outside, -jnp.inf, jnp.sum(_times(logits, chosen), axis=-1))

    def mode(self) -> Any:
        return jnp.argmax(self._given, axis=-1).astype(self._dtype)


def _times(x, y):
    """x y, and 0 where y is 0, whatever x."""
    return jnp.where(y == 0, jnp.zeros((), jnp.result_type(x, y)), x * y)
